"""The presets: published numbers where they are published, and an origin for every value."""

import pytest

from tcgsplat.config import SlamConfig, settings
from tcgsplat.errors import ConfigError
from tcgsplat.presets import PRESETS, SUMMARIES, Setting, origins, preset

PAPER = ("paper-replica", "paper-tum", "paper-scannet")

# Neither the paper nor the base system has these: when a frame is lost, and parts that the paper presets do not use.
OURS_EVERYWHERE = {
    "tracker.max_step", "tracker.max_turn", "tracker.min_overlap", "tracker.min_agreement", "tracker.min_correlation",
    "loop.min_coverage", "loop.min_agreement", "loop.min_correlation", "loop.lag", "loop.relocalize_after",
    "mapper.seeding.spacing", "mapper.seeding.footprint", "mapper.seeding.flatness", "mapper.seeding.behind",
    "confidence.error_ref", "confidence.error_max", "confidence.error_memory", "confidence.error_prior",
    "confidence.noise_floor", "confidence.noise_slope",
}  # fmt: skip


def test_names():
    assert list(PRESETS) == ["default", "base", *PAPER] == list(SUMMARIES)
    assert preset("default") == SlamConfig()


def test_base_is_the_default_without_guidance():
    default, base = settings(preset("default")), settings(preset("base"))
    changed = {path: base[path] for path in base if base[path] != default[path]}
    assert changed == {f"confidence.{name}": False for name in ("guide_mapping", "guide_tracking", "rerank_views")}


@pytest.mark.parametrize("name", PRESETS)
def test_origins_tell_every_value_that_a_run_would_use(name: str):
    rows = origins(name)
    assert {row.path: row.value for row in rows} == settings(preset(name))
    assert {row.origin for row in rows} == {"paper", "base", "ours"}
    assert all(row.reason for row in rows)


# Values as the base system's configuration files and Section 4.1 of the paper have them.
@pytest.mark.parametrize(
    ("path", "replica", "tum", "scannet"),
    [
        ("tracker.descent.iterations", 60, 200, 200),
        ("tracker.descent.rotation_rate", 0.0002, 0.002, 0.002),
        ("tracker.descent.translation_rate", 0.002, 0.01, 0.01),
        ("tracker.descent.color_weight", 0.95, 0.6, 0.6),
        ("tracker.descent.min_alpha", 0.0, 0.0, 0.98),
        ("tracker.descent.outlier_factor", 50.0, 0.0, 50.0),
        ("tracker.descent.mask_color", False, True, True),
        ("schedule.map_every", 5, 1, 1),
        ("schedule.submap_by", "motion", "motion", "interval"),
        ("mapper.iterations", 100, 100, 100),
        ("mapper.first_iterations", 1000, 100, 100),
        ("mapper.min_opacity", 0.1, 0.5, 0.5),
        ("mapper.seeding.first_points", 600_000, 100_000, 100_000),
        ("mapper.seeding.points", 0, 30_000, 30_000),
        ("confidence.decay_time", 40.0, 100.0, 100.0),
        ("confidence.maturity_time", 4.0, 10.0, 10.0),
        ("seed", 1, 0, 0),
    ],
)
def test_published_values(path: str, replica: object, tum: object, scannet: object):
    assert tuple(settings(preset(name))[path] for name in PAPER) == (replica, tum, scannet)


@pytest.mark.parametrize("name", PAPER)
def test_paper_presets_follow_the_text_and_not_our_default(name: str):
    by_path = {row.path: row for row in origins(name)}
    assert by_path["confidence.model"].value == "paper"
    assert by_path["confidence.stability_reduction"].value == "mean"
    assert by_path["confidence.step_scale_mode"].value == "gradient"
    assert by_path["confidence.step_scale_mode"].origin == "paper"
    assert by_path["tracker.solver"].value == "descent"
    assert by_path["mapper.seeding.recipe"].value == "points"
    stated = {row.path for row in by_path.values() if row.origin == "paper"}
    assert {"confidence.tracking_floor", "confidence.stability_weight", "confidence.step_scale_min"} <= stated


@pytest.mark.parametrize("name", PAPER)
def test_no_published_setting_rests_on_our_default(name: str):
    """Our default may be tuned at any time: what the paper presets use must not move with it."""
    defaults = origins("default")
    same = {row.path for row in origins(name) if row in defaults}
    assert {path for path in same if not path.startswith("tracker.alignment.")} <= OURS_EVERYWHERE


def test_a_default_is_read_from_its_docstring():
    by_path = {row.path: row for row in origins("default")}
    assert by_path["confidence.stability_weight"] == Setting(
        "confidence.stability_weight", 0.01, "paper", "lambda_stab, per metre"
    )
    assert by_path["mapper.rates.quats"].origin == "base"  # marked once, by its class


@pytest.mark.parametrize("name", ["paper-tumm", "zebra"])
def test_unknown_preset(name: str):
    with pytest.raises(ConfigError) as caught:
        preset(name)
    advice = "did you mean paper-tum?" if name == "paper-tumm" else "choose one of default, base, paper-replica"
    assert f"there is no preset {name}; {advice}" in str(caught.value)
