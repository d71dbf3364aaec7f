"""A synthetic apartment as an RGB-D sequence: exact depth, poses and mesh; a real camera's faults on demand."""

from tcgsplat.datasets.synthetic.synthesis import SynthConfig, synthesize

__all__ = ["SynthConfig", "synthesize"]
