"""The GPU backend; see README.md for its design in one page."""

from tcgsplat.render.cuda.graphs import Graphs
from tcgsplat.render.cuda.rasterizer import CudaRasterizer

__all__ = ["CudaRasterizer", "Graphs"]
