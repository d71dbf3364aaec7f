"""Pictures: size, that their parts are where they belong, and that a run's keyframes get into them."""

from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib import colormaps

from tcgsplat.evaluation import canvas, figures


def view(title: str, height: int = 48, width: int = 64, nearest: float = 1.0) -> figures.View:
    depth = torch.linspace(nearest, nearest + 2.0, width).repeat(height, 1)
    depth[:, :8] = 0.0
    return figures.View(
        title=title,
        image=torch.tensor([1.0, 0.0, 0.0]).expand(height, width, 3),
        color=torch.tensor([0.0, 1.0, 0.0]).expand(height, width, 3),
        depth=depth,
        confidence=torch.linspace(0.0, 1.0, height)[:, None].repeat(1, width),
    )


def test_contact_sheet_has_four_rows_and_a_column_for_each_view() -> None:
    sheet = figures.contact_sheet([view("0.0 s", nearest=1.0), view("1.0 s", nearest=4.0)], width=900)
    assert (sheet.dtype, sheet.shape[1:]) == (np.dtype(np.uint8), (900, 3))
    red = (sheet == [255, 0, 0]).all(axis=2)
    green = (sheet == [0, 255, 0]).all(axis=2)
    rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
    tile_width = red[rows[0]].sum() // 2
    assert tile_width > 350
    assert abs(len(rows) / tile_width - 48 / 64) < 0.01
    assert len(columns) == 2 * tile_width
    assert np.array_equal(np.flatnonzero(green.any(axis=0)), columns)
    assert np.flatnonzero(green.any(axis=1)).min() > rows.max()
    assert sheet.shape[0] > 4 * len(rows)
    # One range of depth for both columns: the near view is blue, the far one red.
    depth_row = sheet[rows[0] + 2 * (len(rows) + 6) + len(rows) // 2].astype(int)
    first, second = depth_row[columns[:tile_width]], depth_row[columns[tile_width:]]
    assert first[tile_width // 2, 2] > first[tile_width // 2, 0]
    assert second[tile_width // 2, 0] > second[tile_width // 2, 2]
    assert first[tile_width // 20].tolist() == [222, 222, 222]  # no depth
    # The colour bars beside the last column are not covered.
    beside = sheet[rows.max() + len(rows) + 20 :, columns.max() + 5 :]
    assert (np.ptp(beside.astype(int), axis=2) > 60).sum() > 1000


def test_contact_sheet_of_nothing_but_holes() -> None:
    hole = view("0.0 s")
    sheet = figures.contact_sheet([figures.View("0.0 s", hole.image, hole.color, hole.depth * 0, hole.confidence)])
    assert sheet.shape[1] == 1600


def paths(n: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    angle = np.linspace(0.0, 2 * np.pi, n)
    truth = np.stack((3.0 * np.cos(angle), 2.0 * np.sin(angle), 0.1 * np.sin(5 * angle)), axis=1)
    noise = np.random.default_rng(0).normal(0.0, 0.01, (n, 3))
    return np.arange(n) / 30.0, (truth + noise) @ np.diag([-1.0, -1.0, 1.0]) + 5.0, truth


def test_trajectory_plot_with_and_without_truth() -> None:
    times, estimated, truth = paths()
    whole = figures.trajectory_plot(times, estimated, truth, switches=[30, 70])
    without = figures.trajectory_plot(times, estimated)
    assert whole.dtype == np.uint8
    assert whole.shape[1] == without.shape[1] == 1200
    assert whole.shape[0] > without.shape[0] + 100  # the error over time stands below
    partial = truth.copy()
    partial[:60] = np.nan
    assert figures.trajectory_plot(times, estimated, partial).shape == whole.shape
    assert figures.trajectory_plot(times, estimated, np.full_like(truth, np.nan)).shape == without.shape


def test_a_legend_names_the_lines_of_the_trajectory_plot_and_lost_frames_are_marked() -> None:
    times, estimated, truth = paths()
    whole = figures.trajectory_plot(times, estimated, truth, switches=[30])
    broken = figures.trajectory_plot(times, estimated, truth, switches=[30], lost=range(80, 100))

    def crimson(picture: np.ndarray) -> np.ndarray:
        return np.abs(picture.astype(int) - [220, 20, 60]).max(axis=2) < 40

    legend = slice(46, 66)
    estimated_line = np.array(colormaps["plasma"](0.35 * 0.88)[:3]) * 255
    for picture in (whole, broken, figures.trajectory_plot(times, estimated)):
        assert (np.abs(picture[legend] - estimated_line).max(axis=2) < 30).sum() > 20
    assert not crimson(whole).any()
    assert crimson(broken[legend]).any(), "named"
    assert crimson(broken[100:-300]).sum() > 5 * crimson(broken[legend]).sum(), "on the path"
    assert crimson(broken[-90:]).sum() > 5 * crimson(broken[legend]).sum(), "and below its error"


def test_trajectory_plot_is_aligned_to_the_truth() -> None:
    times, estimated, truth = paths()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    one = figures.trajectory_plot(times, estimated, truth)
    other = figures.trajectory_plot(times, estimated @ turn.T + 1.0, truth)
    assert one.shape == other.shape
    assert np.abs(one.astype(int) - other.astype(int)).mean() < 0.05


def test_trajectory_plot_of_odd_paths() -> None:
    still = np.zeros((10, 3))
    assert figures.trajectory_plot(np.arange(10.0), still, still).shape[1] == 1200
    assert figures.trajectory_plot(np.zeros(1), still[:1]).shape[1] == 1200
    tall = paths()[2] * np.array([0.1, 9.0, 0.1])
    assert figures.trajectory_plot(paths()[0], tall, tall).shape[0] < 1200


def test_png_comes_back(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    canvas.write_png(tmp_path / "a.png", picture)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], picture)
