"""Plots of uncertainty scores: size, that their parts are where the numbers say, and files that repeat."""

import math
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import canvas
from tcgsplat.evaluation import uncertainty as un
from tcgsplat.evaluation import uncertainty_plots as plots
from tcgsplat.evaluation.paired import PairedDifference, Run, paired_differences
from tcgsplat.evaluation.reaction import reaction

BLUE, VERMILION = "#0072B2", "#D55E00"


def texts(figure: Figure) -> list[str]:
    inside = [text.get_text() for axes in figure.axes for text in axes.texts]
    return [*(text.get_text() for text in figure.texts), *inside]


def points(axes: Axes, color: str, place: int = 0) -> np.ndarray:
    """Coordinates of a line of a colour."""
    lines = [line for line in axes.lines if line.get_color() == color]
    return np.asarray(lines[place].get_xydata())


def of_color(picture: canvas.Picture, color: str) -> np.ndarray:
    wanted = np.round(255 * np.array(to_rgb(color)))
    return (np.abs(picture.astype(int) - wanted) <= 2).all(axis=2)


def images(count: int = 4) -> dict[str, list[un.Sparsification]]:
    generator = np.random.default_rng(0)
    maps: dict[str, list[un.Sparsification]] = {"reversed": [], "ours": [], "constant": []}
    for i in range(count):
        e = (i + 1) * generator.exponential(size=800)
        for name, u in (("reversed", -e), ("ours", e + generator.random(800)), ("constant", np.ones(800))):
            maps[name].append(un.sparsification(u, e))
    return {"ours": maps["ours"], "reversed": maps["reversed"], "constant": maps["constant"]}


def test_sparsification_shows_mean_curves_relative_to_each_image() -> None:
    maps = images()
    figure = plots.sparsification_plot(maps, title="depth", width=1000)
    picture = canvas.drawn(figure)
    assert (picture.dtype, picture.shape[1]) == (np.dtype(np.uint8), 1000)
    curve = points(figure.axes[0], BLUE)
    expected = np.mean([one.error / one.random for one in maps["ours"]], axis=0)
    np.testing.assert_allclose(curve, np.stack((np.linspace(0, 99.9, 100), expected), axis=1))
    oracle = points(figure.axes[0], "black")
    np.testing.assert_allclose(oracle[:, 1], np.mean([one.oracle / one.random for one in maps["ours"]], axis=0))
    assert of_color(picture, BLUE).sum() > 1000
    assert figure.axes[0].get_ylim() == (0.0, 1.5)  # the reversed map leaves the frame


def test_sparsification_ranks_maps_in_its_legend() -> None:
    maps = images()
    written = texts(plots.sparsification_plot(maps, title="depth"))
    names = [text for text in written if text in (*maps, "random", "oracle")]
    assert names == ["ours", "constant", "reversed", "random", "oracle"]
    assert written[written.index("constant") - 1] == "1.00"
    mean = np.mean([one.normalised_ause for one in maps["ours"]])
    assert written[written.index("ours") - 1] == f"{mean:.2f}"
    assert "depth: mean of 4 images" in written


def test_sparsification_leaves_out_images_without_error_and_refuses_a_map_with_none() -> None:
    maps, blank = images(1), un.sparsification(np.ones(800), np.zeros(800))
    assert "one image" in texts(plots.sparsification_plot({"ours": [*maps["ours"], blank]}))
    with pytest.raises(EvaluationError, match="'ours' has any error"):
        plots.sparsification_plot({"ours": [blank]})


@pytest.mark.parametrize("spread", [0.2, 2.0])  # linear, logarithmic
def test_reliability_shows_bins_in_the_unit_asked_for(spread: float) -> None:
    expected = 0.01 * np.exp(spread * np.random.default_rng(0).standard_normal(3000))
    found = un.reliability(expected, 2 * expected)
    figure = plots.reliability_plot({"ours": found, "calibrated": un.reliability(expected, expected)}, width=900)
    panel, below = figure.axes[:2]
    np.testing.assert_allclose(points(panel, BLUE), 100 * np.stack((found.expected, found.found), axis=1))
    assert panel.get_xscale() == ("log" if spread > 1 else "linear")
    assert below.get_xlim() == panel.get_xlim()
    assert below.get_xlabel() == "error expected [cm]"
    shares = [patch.get_data().values.sum() for patch in below.patches]
    assert shares == [pytest.approx(100.0)] * len(shares)
    written = texts(figure)
    assert written[written.index("ours") - 1] == "50 %"
    assert written[written.index("calibrated") - 1] == "0 %"
    assert canvas.drawn(figure).shape[1] == 900


def test_reliability_of_bins_that_expect_nothing_is_drawn_and_of_nothing_at_all_refused() -> None:
    e = np.concatenate((np.zeros(50), np.geomspace(0.001, 1.0, 50)))
    canvas.drawn(plots.reliability_plot({"ours": un.reliability(e, e)}, unit="", scale=1.0))
    with pytest.raises(EvaluationError, match="no calibration to draw"):
        plots.reliability_plot({"ours": un.reliability(np.zeros(9), np.zeros(9))})


def difference(arm: str, low: float, high: float) -> PairedDifference:
    mean = (low + high) / 2
    return PairedDifference(arm, "off", mean, low, high, 0.9, {"a": low, "b": high}, 8, 0, 0.04, 0.5)


def test_forest_colours_arms_by_what_their_interval_says() -> None:
    rows = [difference("ours", -0.02, -0.01), difference("shuffled", 0.01, 0.02), difference("constant", -0.01, 0.02)]
    for better, colors in (("lower", (BLUE, VERMILION, "0.45")), ("higher", (VERMILION, BLUE, "0.45"))):
        figure = plots.forest_plot(rows, measure="ATE RMSE", unit="cm", scale=100, better=better)  # type: ignore[arg-type]
        for i, (row, color) in enumerate(zip(rows, colors, strict=True)):
            drawn = points(figure.axes[0], color)
            np.testing.assert_allclose(drawn, [(100 * row.low, i), (100 * row.high, i)])
    written = texts(figure)
    assert "−1.50" in written
    assert "−2.00 … −1.00" in written
    assert {"0.040", "90 % interval"} <= set(written)
    assert figure.axes[0].get_xlabel() == "ATE RMSE, difference to 'off' [cm]"


def test_forest_of_a_single_pair_has_no_interval() -> None:
    values: dict[Run, float] = {("off", "a", 0): 1.0, ("ours", "a", 0): 1.5}
    figure = plots.forest_plot(paired_differences(values, "off"), measure="PSNR", unit="dB", better="higher")
    canvas.drawn(figure)
    written = texts(figure)
    assert {"+0.500", "none of one pair", "none", "1"} <= set(written) and not any("?" in text for text in written)
    with pytest.raises(EvaluationError, match="no difference to draw"):
        plots.forest_plot([], measure="PSNR")


def test_forest_of_equal_runs_has_an_interval_and_no_test() -> None:
    values: dict[Run, float] = {(arm, "a", seed): 1.0 for arm in ("off", "ours") for seed in (0, 1)}
    written = texts(plots.forest_plot(paired_differences(values, "off"), measure="PSNR", unit="dB", better="higher"))
    assert {"+0 … +0", "none", "2"} <= set(written) and "none of one pair" not in written


def test_fault_is_shaded_and_its_reaction_marked() -> None:
    values = np.concatenate((np.full(20, 0.75), np.full(3, 0.7), np.full(17, 0.25), np.full(1, 0.3), np.full(19, 0.75)))
    values[5] = math.nan
    found = reaction(values, 20, 40)
    figure = plots.fault_plot({"object": values, "elsewhere": values * 0 + 0.8}, 20, 40, reaction=found, width=800)
    panel = figure.axes[0]
    assert panel.patches[0].get_extents().bounds[0] == pytest.approx(panel.transData.transform((19.5, 0))[0])
    assert points(panel, "black").tolist() == [[23.0, 0.5]]
    assert points(panel, "black", 1).tolist() == [[41.0, 0.5]]
    assert {"drops after 3 frames", "recovers after 1 frame"} <= set(texts(figure))
    assert canvas.drawn(figure).shape[1] == 800


def test_fault_without_reaction_has_no_marks() -> None:
    figure = plots.fault_plot({"object": np.full(30, 0.5)}, 10, reaction=reaction(np.full(30, 0.5), 10))
    canvas.drawn(figure)
    assert texts(figure) == [""]


def test_files_are_png_or_svg_and_equal_figures_give_equal_files(tmp_path: Path) -> None:
    for name in ("a.png", "b.png", "a.svg", "b.svg"):
        plots.write(tmp_path / name, plots.forest_plot([difference("ours", -2, -1)], measure="ATE", width=1200))
    assert cv2.imread(str(tmp_path / "a.png")).shape[1] == 1200
    assert ElementTree.parse(tmp_path / "a.svg").getroot().get("width") == "864pt"
    for suffix in ("png", "svg"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
