"""Drawing in pixels: matplotlib figures without its global state, colour maps on arrays, PNG files."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from tcgsplat.storage import atomic

Picture = UInt8[np.ndarray, "rows columns 3"]
Pixels = int | float

INK = "0.2"
"""Grey of text and ticks, 0 black, 1 white."""
_DPI = 100


def write_png(path: Path, picture: Picture) -> None:
    """Put a picture at `path`, all of it or nothing."""
    _, png = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    atomic.write_bytes(path, png.tobytes())


def blank(width: int, height: int) -> Figure:
    """A white figure of so many pixels."""
    return Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")


def drawn(figure: Figure) -> Picture:
    """The figure's pixels."""
    agg = FigureCanvasAgg(figure)
    agg.draw()  # type: ignore[no-untyped-call]
    return np.array(agg.buffer_rgba())[..., :3]  # type: ignore[no-untyped-call]


def axes(figure: Figure, x: Pixels, y: Pixels, width: Pixels, height: Pixels) -> Axes:
    """Axes in a box given in pixels from the figure's upper left corner."""
    across, down = figure.get_size_inches() * _DPI
    return figure.add_axes((x / across, 1.0 - (y + height) / down, width / across, height / down))


def write(
    figure: Figure,
    x: Pixels,
    y: Pixels,
    text: str,
    *,
    size: int = 12,
    rotation: int = 0,
    align: Literal["left", "center", "right"] = "center",
) -> None:
    """Text at a place given in pixels from the figure's upper left corner, in the middle of its height."""
    across, down = figure.get_size_inches() * _DPI
    figure.text(x / across, 1 - y / down, text, size=size, rotation=rotation, color=INK, ha=align, va="center")


def color_bar(box: Axes, colors: ScalarMappable, unit: str) -> None:
    """Fill a slim box with the scale of a colour map; each tick tells the unit."""
    bar = box.figure.colorbar(colors, cax=box)
    bar.outline.set_visible(False)  # type: ignore[operator]
    box.yaxis.set_major_locator(MaxNLocator(5))
    box.yaxis.set_major_formatter(f"{{x:g}} {unit}".rstrip())
    box.tick_params(labelsize=11, length=3, colors=INK)


def legend(figure: Figure, panel: Axes, x: Pixels, y: Pixels) -> None:
    """The labels of a panel in one line that ends at a place given in pixels from the upper left corner."""
    across, down = figure.get_size_inches() * _DPI
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="center right",
        bbox_to_anchor=(x / across, 1 - y / down),
        borderaxespad=0,
        ncols=len(labels),
        frameon=False,
        fontsize=11,
        labelcolor=INK,
    )


def painted(values: Float[np.ndarray, "rows columns"], colors: ScalarMappable) -> Picture:
    """A plane of numbers in the colours of a map."""
    return np.asarray(colors.to_rgba(values, bytes=True))[..., :3].copy()


def resized(picture: Picture, width: int, height: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """The picture at another size, each new pixel the mean of what it covers."""
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
