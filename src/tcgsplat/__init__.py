"""RGB-D SLAM over local 3D Gaussian submaps, with a temporal confidence for every Gaussian.

The public names below are imported when first used, so that `import tcgsplat` and `tcgsplat --help` cost nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from tcgsplat.config import SlamConfig
    from tcgsplat.datasets import open_sequence
    from tcgsplat.evaluation.report import evaluate
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.slam import Slam

__version__ = "0.1.0"
__all__ = ["Slam", "SlamConfig", "__version__", "evaluate", "open_rasterizer", "open_sequence"]

_HOME: Final = {
    "Slam": "tcgsplat.slam",
    "SlamConfig": "tcgsplat.config",
    "evaluate": "tcgsplat.evaluation.report",
    "open_rasterizer": "tcgsplat.render.backends",
    "open_sequence": "tcgsplat.datasets",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'tcgsplat' has no attribute {name!r}")
