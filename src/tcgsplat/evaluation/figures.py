"""Pictures of a run: what the camera saw beside what the map shows, and the path beside the true one.

Every picture is an array of RGB bytes; `canvas.write_png` puts one on disk.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize

from tcgsplat.datasets.sequence import Sequence as RgbdSequence
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import ate, canvas
from tcgsplat.evaluation.canvas import Picture
from tcgsplat.evaluation.views import (
    PosedFrame,
    learnt_delay,
    training_views,
    velocities_by_frame,
    withheld_rows,
    withheld_views,
)
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.submap import Submap
from tcgsplat.scene.trajectory import TrackedPose
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Image, Plane

_NO_DEPTH = 222
"""Grey level of a pixel that has no depth."""
_LOST = "crimson"
"""Colour of frames in which tracking was lost."""
_TALLEST = 620
"""Pixels that the panels of a path may be high."""


@dataclass(frozen=True)
class View:
    """What the camera and the map show from one pose: a column of the contact sheet."""

    title: str
    image: Image
    """The camera's."""
    color: Image
    """Rendered."""
    depth: Plane
    """Rendered, metres; 0 where there is none."""
    confidence: Plane
    """Rendered, in [0, 1]."""


def contact_sheet(views: Sequence[View], *, width: int = 1600) -> Picture:
    """Input, render, depth and confidence (rows) at several times (columns): the paper's Fig. 3.

    One range of depth and one of confidence hold for all columns; pixels without depth are grey.

    Args:
        views: At least one; images of one size.
        width: Pixels across the sheet.
    """
    depth_colors = ScalarMappable(_depth_range(views), colormaps["turbo"])
    confidence_colors = ScalarMappable(Normalize(0.0, 1.0), colormaps["viridis"])
    rows = {
        "input": [_bytes(view.image) for view in views],
        "render": [_bytes(view.color) for view in views],
        "depth": [_painted_depth(view.depth, depth_colors) for view in views],
        "confidence": [canvas.painted(view.confidence.detach().cpu().numpy(), confidence_colors) for view in views],
    }
    bars = {"depth": (depth_colors, "m"), "confidence": (confidence_colors, "")}

    left, right, top, bottom, gap = 34, 80, 36, 12, 6
    tile_width = (width - left - right - gap * (len(views) - 1)) // len(views)
    tile_height = round(tile_width * views[0].depth.shape[0] / views[0].depth.shape[1])
    sheet = np.full((top + 4 * tile_height + 3 * gap + bottom, width, 3), 255, dtype=np.uint8)
    figure = canvas.blank(width, len(sheet))
    for i, view in enumerate(views):
        canvas.write(figure, left + i * (tile_width + gap) + tile_width / 2, top / 2, view.title)
    for j, (name, tiles) in enumerate(rows.items()):
        y = top + j * (tile_height + gap)
        canvas.write(figure, left / 2, y + tile_height / 2, name, rotation=90)
        for i, tile in enumerate(tiles):
            x = left + i * (tile_width + gap)
            sheet[y : y + tile_height, x : x + tile_width] = canvas.resized(tile, tile_width, tile_height)
        if name in bars:
            canvas.color_bar(canvas.axes(figure, width - right + 8, y, 14, tile_height), *bars[name])
    figure.figimage(sheet, zorder=-1)
    return canvas.drawn(figure)


def contact_sheet_of(
    run: RunDirectory, sequence: RgbdSequence | None, rasterizer: Rasterizer, *, columns: int = 6, width: int = 1600
) -> Picture:
    """The contact sheet of a run: views at even times, each drawn from its own submap as saved.

    Frames withheld from the map are shown if the sequence is at hand and there are any, else keyframes, which the map
    was optimised on; the titles say which.

    Raises:
        ArchiveError: if a file of the run is damaged.
        DatasetError: if a withheld frame cannot be read.
        EvaluationError: if the run has no sealed submap.
    """
    trajectory, atlas = run.trajectory()
    saved = run.submap_count
    rows = tuple(row for row in trajectory.rows if row.submap_index < saved)
    if not rows:
        raise EvaluationError(f"{run.path} has no sealed submap yet; let the run go on for longer, or run again")
    withheld = withheld_rows(run, trajectory) if sequence is not None else ()
    shown = withheld or rows
    velocities = velocities_by_frame(trajectory, atlas)
    places = np.unique(np.linspace(0, len(shown) - 1, columns).round().astype(int)).tolist()
    views: list[View] = []
    for submap_index, group in groupby((shown[i] for i in places), key=lambda row: row.submap_index):
        submap, chosen = run.load_submap(submap_index), list(group)
        if withheld and sequence is not None:
            posed = withheld_views(chosen, velocities, sequence, learnt_delay(run))
        else:
            posed = _nearest(submap, chosen)
        views += [_view(submap, one, rasterizer, start=rows[0].timestamp) for one in posed]
    return contact_sheet(views, width=width)


def trajectory_plot(
    times: Float[np.ndarray, " n"],
    estimated: ate.Positions,
    truth: ate.Positions | None = None,
    *,
    switches: Sequence[int] = (),
    lost: Sequence[int] = (),
    width: int = 1200,
) -> Picture:
    """The path from two sides, coloured by its error, or by time where there is no truth (the paper's Fig. 2).

    The first panel shows the two coordinates that spread most, in the order of the alphabet: so it is seen from above
    where z points up, and also in the frame of a first camera, where y points down.

    Args:
        times: Seconds since the start.
        estimated: Camera centres, metres.
        truth: True centres, metres, NaN where unknown. The estimate is aligned to them (rigid, no scale).
        switches: Rows with which a new submap begins.
        lost: Rows of frames in which tracking was lost.
        width: Pixels across the picture.
    """
    path = _aligned_path(times, estimated, truth)
    points = np.concatenate((path.estimated, path.truth))
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    spread = high - low
    span = np.maximum(1.12 * spread, 0.35 * spread.max() + 1e-3)  # metres shown; no panel is to be a slit
    aside = int(spread.argmin())
    across, up = (axis for axis in range(3) if axis != aside)

    left, between, right, top, bottom, labels, strip = 80, 84, 120, 84, 62, 16, 130
    room = width - left - between - right
    scale = min(float(room / (span[across] + span[aside])), _TALLEST / float(span[up]))  # pixels a metre
    height = round(scale * float(span[up]))
    below = top + height + bottom
    figure = canvas.blank(width, below + (labels + strip + bottom if path.known.any() else 0))
    x = left + (room - scale * float(span[across] + span[aside])) / 2
    for axis in (across, aside):
        panel = canvas.axes(figure, x, top, scale * float(span[axis]), height)
        for name, i in (("x", axis), ("y", up)):
            middle, half = (low[i] + high[i]) / 2, span[i] / 2
            panel.set(**{f"{name}lim": (middle - half, middle + half), f"{name}label": f"{'xyz'[i]} [m]"})
        _draw_path(panel, path, (axis, up), switches, lost)
        x += scale * float(span[axis]) + between
    canvas.color_bar(canvas.axes(figure, x - between + 22, top, 14, height), path.colors, path.unit)
    canvas.write(figure, left, top / 3, path.title, size=13, align="left")
    canvas.legend(figure, panel, width - 10, 2 * top / 3)
    if path.known.any():
        panel = canvas.axes(figure, left, below + labels, width - left - right, strip)
        _draw_error(panel, path, switches, lost)
        canvas.legend(figure, panel, width - right, below + labels / 4)
    return canvas.drawn(figure)


def trajectory_plot_of(run: RunDirectory, sequence: RgbdSequence | None, *, width: int = 1200) -> Picture:
    """The path of a run, beside the ground truth of its sequence as far as there is one.

    Raises:
        ArchiveError: if a file of the run is damaged.
        DatasetError: if the ground truth is there but cannot be read.
        EvaluationError: if the run has no trajectory.
    """
    trajectory, atlas = run.trajectory()
    rows = trajectory.rows
    if not rows:
        raise EvaluationError(f"{run.path} has no trajectory yet; let the run go on for longer, or run again")
    true_poses = sequence.ground_truth() if sequence is not None else {}
    truth = np.full((len(rows), 3), np.nan)
    for i, row in enumerate(rows):
        if row.frame_index in true_poses:
            truth[i] = true_poses[row.frame_index][:3, 3].tolist()
    return trajectory_plot(
        np.array([row.timestamp - rows[0].timestamp for row in rows]),
        ate.positions(trajectory.world(atlas)),
        truth,
        switches=[i for i in range(1, len(rows)) if rows[i].submap_index != rows[i - 1].submap_index],
        lost=[i for i, row in enumerate(rows) if row.lost],
        width=width,
    )


@dataclass(frozen=True)
class _Path:
    """A path in the frame of the truth, as far as there is one."""

    times: Float[np.ndarray, " n"]
    estimated: ate.Positions
    truth: ate.Positions
    """NaN where unknown."""

    @property
    def known(self) -> Bool[np.ndarray, " n"]:
        """Where there is a truth."""
        return np.asarray(np.isfinite(self.truth).all(axis=1))

    @property
    def error(self) -> Float[np.ndarray, " n"]:
        """Centimetres, NaN where unknown."""
        return np.asarray(100.0 * np.linalg.norm(self.estimated - self.truth, axis=1))

    @property
    def rmse(self) -> float:
        """Centimetres."""
        return float(np.sqrt(np.nanmean(np.square(self.error))))

    @property
    def title(self) -> str:
        """What is seen, in a line."""
        if not self.known.any():
            return f"{len(self.times)} frames, no ground truth"
        return f"ATE {self.rmse:.2f} cm (RMSE, rigid alignment) over {self.known.sum()} of {len(self.times)} frames"

    @property
    def value(self) -> Float[np.ndarray, " n"]:
        """What the colour tells: the error, or the time."""
        return self.error if self.known.any() else self.times

    @property
    def unit(self) -> str:
        """Of the value."""
        return "cm" if self.known.any() else "s"

    @property
    def color(self) -> tuple[float, float, float, float]:
        """That stands for all of them."""
        return self.colors.cmap(0.35)

    @property
    def colors(self) -> ScalarMappable:
        """From 0 to the greatest value, without the map's pale end, to be seen on white; dark grey where unknown."""
        shades = ListedColormap(colormaps["plasma"](np.linspace(0.0, 0.88, 256))).with_extremes(bad="0.4")
        return ScalarMappable(Normalize(0.0, max(float(np.nanmax(self.value)), 1e-9)), shades)


def _aligned_path(times: Float[np.ndarray, " n"], estimated: ate.Positions, truth: ate.Positions | None) -> _Path:
    if truth is not None:
        known = np.isfinite(truth).all(axis=1)
        if known.sum() >= 3:
            return _Path(times, ate.align(estimated[known], truth[known]).apply(estimated), truth)
    return _Path(times, estimated, np.full_like(estimated, np.nan))


def _draw_path(panel: Axes, path: _Path, axes: tuple[int, int], switches: Sequence[int], lost: Sequence[int]) -> None:
    """Two coordinates against each other: the truth in grey below, the estimate in colour above it."""
    estimated, truth = path.estimated[:, axes], path.truth[:, axes]
    _style(panel)
    if path.known.any():
        panel.plot(*truth.T, color="0.72", linewidth=4.5, solid_capstyle="round", label="ground truth")
    segments = np.stack((estimated[:-1], estimated[1:]), axis=1)
    line = LineCollection(list(segments), cmap=path.colors.cmap, norm=path.colors.norm, linewidth=1.8, capstyle="round")
    line.set_array(np.ma.masked_invalid(path.value[1:]))
    panel.add_collection(line, autolim=False)
    what = "its error" if path.known.any() else "time"
    panel.plot((), (), color=path.color, linewidth=1.8, label=f"estimated, coloured by {what}")
    if lost:
        panel.plot(*estimated[list(lost)].T, "x", color=_LOST, markersize=6, label="tracking lost", zorder=3)
    if switches:
        _draw_marks(panel, estimated[list(switches)], "D", 5, "white", "new submap")
    _draw_marks(panel, estimated[:1], "o", 10, "limegreen", "start")


def _draw_marks(panel: Axes, points: Float[np.ndarray, "k 2"], shape: str, size: int, fill: str, label: str) -> None:
    panel.plot(*points.T, shape, markersize=size, markerfacecolor=fill, markeredgecolor="black", label=label, zorder=3)


def _draw_error(panel: Axes, path: _Path, switches: Sequence[int], lost: Sequence[int]) -> None:
    """Error over time, with the times at which submaps begin and those at which tracking was lost."""
    _style(panel)
    panel.fill_between(path.times, path.error, color=path.color, alpha=0.25, linewidth=0)
    panel.plot(path.times, path.error, color=path.color, linewidth=1.4, label="error of the position")
    panel.axhline(path.rmse, color=canvas.INK, linewidth=1, linestyle="--", label="RMSE")
    above = panel.get_xaxis_transform()
    if lost:
        panel.plot(
            path.times[list(lost)], np.zeros(len(lost)), "x", color=_LOST, markersize=6, label="tracking lost",
            transform=above, clip_on=False,
        )  # fmt: skip
    if switches:
        panel.vlines(path.times[list(switches)], 0, 1, color="0.75", linewidth=1, label="new submap", transform=above)
    panel.set(xlim=(path.times[0], path.times[-1]), xlabel="time [s]", ylabel="error [cm]")
    panel.set_ylim(bottom=0)


def _style(panel: Axes) -> None:
    panel.grid(color="0.92", linewidth=0.8)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=10, colors=canvas.INK, length=3)
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color("0.6")


def _nearest(submap: Submap, rows: Iterable[TrackedPose]) -> Iterator[PosedFrame]:
    """The keyframe next to each row in time, once."""
    indices = np.array([keyframe.frame.index for keyframe in submap.keyframes])
    for place in sorted({int(np.abs(indices - row.frame_index).argmin()) for row in rows}):
        yield from training_views(submap, slice(place, place + 1))


def _view(submap: Submap, posed: PosedFrame, rasterizer: Rasterizer, start: float) -> View:
    frame = posed.frame
    rendering = render_view(submap, frame.camera, posed.T_map_cam, rasterizer)
    kind = "withheld" if posed.withheld else "keyframe"
    title = f"{frame.timestamp - start:.1f} s, submap {submap.index}, {kind}"
    color = posed.exposure.applied(rendering.color)
    return View(title, frame.color, color, rendering.depth, rendering.confidence)


def _depth_range(views: Sequence[View]) -> Normalize:
    """From the 1st to the 99th percentile of all depths, metres: one far pixel is not to turn the rest blue."""
    depths = torch.cat([view.depth[view.depth > 0] for view in views]).cpu().numpy()
    low, high = np.percentile(depths, (1, 99)) if depths.size else (0.0, 1.0)
    return Normalize(float(low), float(high))


def _bytes(image: Image) -> Picture:
    return np.asarray((image.detach().cpu().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy())


def _painted_depth(depth: Plane, colors: ScalarMappable) -> Picture:
    picture = canvas.painted(depth.detach().cpu().numpy(), colors)
    picture[depth.cpu().numpy() <= 0] = _NO_DEPTH
    return picture
