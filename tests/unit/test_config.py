"""Settings as text: read back equal, and every mistake answered by a sentence that helps."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcgsplat.config import SlamConfig, described, from_toml, settings, to_toml, with_settings
from tcgsplat.errors import ConfigError

any_float = st.floats(allow_nan=False)
positive = st.floats(min_value=0, exclude_min=True)

# A setting of every type, those without limits given any value at all, infinite ones among them.
changes = st.fixed_dictionaries(
    {},
    optional={
        "tracker.solver": st.sampled_from(["alignment", "descent"]),
        "tracker.alignment.iterations": st.lists(st.integers(1, 9), min_size=1, max_size=5).map(tuple),
        "tracker.alignment.gate": positive,
        "tracker.descent.soft_alpha": st.booleans(),
        "tracker.max_step": positive,
        "mapper.isotropy_weight": positive,
        "mapper.rates.means": any_float,
        "mapper.seeding.push_back": any_float,
        "schedule.submap_distance": positive,
        "schedule.submap_angle": positive,
        "confidence.decay_time": positive,
        "confidence.stability_reduction": st.sampled_from(["mean", "sum"]),
        "confidence.guide_mapping": st.booleans(),
        "seed": st.integers(0, 2**63 - 1),
    },
)


@given(changes)
def test_text_reads_back_as_the_very_same_settings(values: dict[str, object]):
    config = with_settings(SlamConfig(), values)
    assert settings(config) == settings(SlamConfig()) | values
    assert from_toml(to_toml(config)) == config


def test_text_is_whole_and_explains_itself():
    text = to_toml(SlamConfig())
    assert from_toml(text, with_settings(SlamConfig(), {"seed": 9, "mapper.iterations": 77})) == SlamConfig()
    assert "# w_min, unitless, in (0, 1] [paper].\ntracking_floor = 0.2\n" in text
    assert tomllib.loads(text)["mapper"]["seeding"]["recipe"] == SlamConfig().mapper.seeding.recipe
    assert max(map(len, text.splitlines())) <= 120


def test_what_the_text_leaves_out_stays():
    base = with_settings(SlamConfig(), {"mapper.iterations": 33, "confidence.guide_tracking": False})
    config = from_toml("[mapper]\nfirst_iterations = 44\n[mapper.rates]\nmeans = 1\n", base)
    assert config == with_settings(base, {"mapper.first_iterations": 44, "mapper.rates.means": 1.0})
    assert isinstance(config.mapper.rates.means, float)
    assert from_toml("") == SlamConfig()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("mapper.iteration = 3", "there is no setting mapper.iteration; did you mean mapper.iterations?"),
        ("[seeding]\nopacity = 0.5", "there is no setting seeding.opacity; did you mean mapper.seeding.opacity?"),
        ("zebra = 1", "there is no setting zebra; `tcgsplat presets default` lists them all"),
        ("mapper = 3", "mapper is a table of settings; set one of them, such as mapper."),
        ("seed.more = 3", "there is no setting seed.more; did you mean seed?"),
        ('mapper.iterations = "many"', 'mapper.iterations is "many"; it must be a whole number'),
        ("mapper.iterations = 1.5", "mapper.iterations is 1.5; it must be a whole number"),
        ("mapper.iterations = true", "mapper.iterations is true; it must be a whole number"),
        ("confidence.initial = true", "confidence.initial is true; it must be a number"),
        ("confidence.initial = nan", "confidence.initial is nan; it must be a number"),
        ("confidence.guide_mapping = 1", "confidence.guide_mapping is 1; it must be true or false"),
        ('tracker.solver = "adam"', 'tracker.solver is "adam"; it must be "alignment" or "descent"'),
        ("tracker.solver = 1", 'tracker.solver is 1; it must be "alignment" or "descent"'),
        ("tracker.alignment.iterations = 3", "iterations is 3; it must be a list, each item a whole number"),
        ('tracker.alignment.iterations = [3, "x"]', 'iterations is "x"; it must be a whole number'),
        ("seed = 2020-01-01", "seed is 2020-01-01; it must be a whole number"),
        ("confidence.p_min = 2", "confidence.p_min is 2.0; it must be above 0 and below 1"),
        ("schedule.map_every = 0", "schedule.map_every is 0; it must be above 0"),
        ("seed =", "the settings are not TOML: "),
    ],
)
def test_a_mistake_is_named_with_what_would_be_right(text: str, sentence: str):
    with pytest.raises(ConfigError) as caught:
        from_toml(text)
    assert sentence in str(caught.value)


def test_every_setting_says_where_its_default_is_from():
    unmarked = [path for path, text in described(SlamConfig()).items() if "[" not in text]
    assert unmarked == []
    assert list(described(SlamConfig())) == list(settings(SlamConfig()))
