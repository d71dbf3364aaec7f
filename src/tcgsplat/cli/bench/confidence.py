"""`tcgsplat bench confidence`: whether confidence is true. Every frame is predicted before it is used."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch

from tcgsplat.cli.bench import Confidence
from tcgsplat.cli.bench.tables import markdown
from tcgsplat.cli.bench.watching import Observer, Predictions, leave_one_out, pairs_of, summary
from tcgsplat.cli.kernels import compile_kernels
from tcgsplat.cli.logs import say
from tcgsplat.cli.progress import RunProgress
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine, versions
from tcgsplat.cli.usage import UsageError
from tcgsplat.config import SlamConfig, to_toml, with_settings
from tcgsplat.datasets.truth import Event, Truth
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import ate
from tcgsplat.evaluation.crossing import crossing
from tcgsplat.evaluation.prediction import OURS, Judged, claim, of_depth
from tcgsplat.evaluation.reaction import Series, reaction
from tcgsplat.evaluation.uncertainty import Reliability, Sparsification
from tcgsplat.evaluation.uncertainty_plots import reliability_plot, sparsification_plot, write
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.slam import Slam
from tcgsplat.storage import atomic
from tcgsplat.storage.store import InMemory

MODELS: Final = ("expectation", "paper")
"""Models of confidence that are compared; the first is the default."""
SHOWN: Final = ("shuffled", "opacity", "observations", "previous residual", "depth edge")
"""Of the other measures, in the plot."""


@dataclass(frozen=True)
class Arm:
    """One way through one sequence."""

    sequence: str
    model: str
    seed: int
    ate_rmse_cm: float | None
    frames_lost: int
    pictures: int
    """That were predicted."""
    depth: Mapping[str, Mapping[str, float | None]]
    """By measure: `ause` (0 oracle, 1 random), `spearman` (median of the frames), `spearman_p10`, `partial_spearman`,
    `auroc` of bad pixels."""
    color: Mapping[str, Mapping[str, float | None]]
    kept_back: Mapping[str, Mapping[str, float | None]]
    """As `depth`, of frames that were never mapped, in the finished submaps."""
    fault_auroc: float | None
    """Of doubt, in telling the pixels of a known fault."""
    fault_auroc_in_map: float | None
    """The same where the map is wrong for it, from all places where it is right."""
    crossing: Mapping[str, float | None] | None
    """What became of the places that somebody hid who walked about, as `Crossing` has it."""
    events: Sequence[Mapping[str, object]]
    """Of the sequence, with what confidence did: `before`, `lowest`, `time_to_drop`, `time_to_recover`, `change`, and
    `back`: just after it."""


def command(args: Confidence, settings: Mapping[str, str]) -> int:
    """Predict, judge, and write the page."""
    config = resolved(args.preset, args.config, settings, args.seed)
    if not args.folders:
        raise UsageError("give the folders of the sequences, such as `tcgsplat synth FOLDER` makes")
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    out = args.out or Path("runs") / "confidence"
    out.mkdir(parents=True, exist_ok=True)
    arms: list[Arm] = []
    judged: dict[str, dict[str, list[Judged]]] = {model: {} for model in MODELS}
    for folder in args.folders:
        for model in MODELS:
            say(f"{folder.name}, model {model}")
            arm, found = performed(folder, with_settings(config, {"confidence.model": model}), rasterizer, args.every)
            arms.append(arm)
            judged[model][arm.sequence] = found.depth
    reliabilities = leave_one_out({name: pairs_of(frames) for name, frames in judged[MODELS[0]].items()})
    calibration = {name: one.normalised_ece for name, one in reliabilities.items()}
    about = (
        f"{rasterizer.name}, preset {args.preset}, seed {config.seed}; {machine()}. One frame in {args.every} is drawn"
    )
    _draw(out, judged, reliabilities)
    page = written(arms, calibration, about)
    atomic.write_text(out / "README.md", page)
    content = {
        "arms": [asdict(arm) for arm in arms], "calibration": calibration, "machine": machine(),
        "versions": versions(), "config": to_toml(config),
    }  # fmt: skip
    atomic.write_text(out / "confidence.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
    sys.stdout.write(f"{page}\n{out / 'README.md'}, {out / 'confidence.json'}\n")
    return 0


def performed(folder: Path, config: SlamConfig, rasterizer: Rasterizer, every: int) -> tuple[Arm, Predictions]:
    """The whole system through a sequence, watched.

    Raises:
        EvaluationError: if nobody knows the truth of the sequence.
    """
    truth = Truth.of(folder)
    if truth is None:
        raise EvaluationError(f"{folder} has no folder `truth`: exact depth is needed; `tcgsplat synth` makes it")
    torch.set_num_threads(1)  # as in a run
    compile_kernels(config, rasterizer)
    store = InMemory()
    slam, observer = Slam(config, rasterizer, store=store), Observer(truth, config, rasterizer, every)
    sequence = Part().open(folder)
    with RunProgress(len(sequence)) as progress:
        for frame in sequence:
            before = slam.reference
            report = slam.step(frame)
            observer.observe(frame, before, slam.reference, report)
            progress.observe(report)
    slam.finish()
    found, poses = observer.found, sequence.ground_truth()
    world = {row.frame_index: T for row, T in zip(slam.trajectory.rows, slam.trajectory.world(slam.atlas), strict=True)}
    common = [index for index in world if index in poses]
    error = ate.ate_rmse_of_poses([world[i] for i in common], [poses[i] for i in common]) if len(common) > 2 else None
    rng = np.random.default_rng(config.seed)
    kept_back = []
    for row in [row for row in slam.trajectory.rows if not (row.mapped or row.lost)][:: 2 * every]:
        frame, depth = sequence.frame(row.frame_index), truth.depth(row.frame_index)
        submap = store.load_submap(row.submap_index)
        claimed = claim(submap, frame.camera, row.T_map_cam, rasterizer, config.confidence, rng)
        if depth is not None:
            kept_back.append(of_depth(claimed, depth, frame.valid, rng))
    arm = Arm(
        truth.sequence.name,
        config.confidence.model,
        config.seed,
        None if error is None else 100.0 * error,
        sum(row.lost for row in slam.trajectory.rows),
        len(found.depth),
        summary(found.depth),
        summary(found.color),
        summary(kept_back),
        found.fault_auroc,
        found.fault_auroc_in_map,
        _crossed(found, config.confidence.p_min),
        [_told(event, found, len(truth.numbers)) for event in truth.events],
    )
    return arm, found


def _crossed(found: Predictions, floor: float) -> dict[str, float | None] | None:
    if not found.looks:
        return None
    told = asdict(crossing(found.looks, floor))
    return {name: None if _is_nan(value) else value for name, value in told.items()}


def _series(event: Event, found: Predictions, frames: int) -> Series:
    """Confidence over the frames: its mean over the event's region if it has one, else over the picture."""
    values = np.full(frames, np.nan)
    for index, mean in (found.regional.get(event, {}) if event.region else found.mean).items():
        values[index] = mean
    return values


def _told(event: Event, found: Predictions, frames: int) -> dict[str, object]:
    """What confidence did about an event."""
    values = _series(event, found, frames)
    told: dict[str, object] = {"name": event.name, "first": event.first, "last": event.last}
    told["of"] = "region" if event.region else "picture"
    during, after = (
        part[np.isfinite(part)] for part in (values[event.first : event.last + 1], values[event.last + 1 :])
    )
    if len(during) > 1:
        told["change"] = float(np.mean(during[-3:]) - np.mean(during[:3]))
    if len(after):
        told["back"] = float(np.mean(after[:3]))
    if event.first > 0:
        what = reaction(values, event.first, event.last + 1 if event.last + 1 < frames else None)
        told |= {name: value for name, value in asdict(what).items() if not _is_nan(value)}
    return told


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _draw(
    out: Path, judged: Mapping[str, Mapping[str, Sequence[Judged]]], reliabilities: Mapping[str, Reliability]
) -> None:
    """Sparsification of the depth's errors, all sequences together, and the reliability of each sequence."""
    measures: dict[str, list[Sparsification]] = {}
    for model in MODELS:
        for frames in judged[model].values():
            for one in frames:
                for name, curve in one.curves.items():
                    shown = f"{model} model" if name == OURS else name
                    if name in (OURS, *(SHOWN if model == MODELS[0] else ())):
                        measures.setdefault(shown, []).append(curve)
    if measures:
        title = "Depth error left after the most doubtful pixels are removed; predicted before seen"
        write(out / "sparsification.png", sparsification_plot(measures, title=title))
    if reliabilities:
        title = "Depth error, expectation fitted to the other sequences"
        write(out / "reliability.png", reliability_plot(reliabilities, title=title))


def written(arms: Sequence[Arm], calibration: Mapping[str, float], about: str) -> str:
    """The page."""
    first = [arm for arm in arms if arm.model == MODELS[0]]
    parts = [
        f"# Is its confidence true?\n\n{about} from the map as it was before it "
        "came, at the pose that tracking found, and held against the true depth. AUSE is over that of random: 0 is an "
        "oracle, 1 knows nothing. Means over frames; of Spearman's correlation the median and the tenth percentile.",
        "## The two models, depth, predicted before seen\n",
        markdown(
            (
                *("sequence", "model", "AUSE", "Spearman", "p10", "partial", "AUROC bad", "AUROC fault", "in map"),
                *("ATE cm", "frames lost", "pictures"),
            ),
            [
                (
                    *(arm.sequence, arm.model, *_cells(arm.depth.get(OURS, {}))),
                    *(_n(arm.fault_auroc, 2), _n(arm.fault_auroc_in_map, 2), _n(arm.ate_rmse_cm)),
                    *(str(arm.frames_lost), str(arm.pictures)),
                )
                for arm in arms
            ],
            left=2,
        ),
        "p10: a tenth of the pictures have less. Partial: beyond what depth, opacity, observations and image gradient "
        "tell. AUROC bad: how well doubt tells pixels that are off by more than 2 cm and 5 %; fault: those where the "
        "recording was wrong, once the map has used it; in map: those that became wrong in the map by that, from all "
        "where it is right. Of frames that were lost nothing is drawn.",
        "## The same of frames that were never mapped, in the finished map\n",
        markdown(
            ("sequence", "model", "AUSE", "Spearman", "p10", "partial", "AUROC bad"),
            [(arm.sequence, arm.model, *_cells(arm.kept_back.get(OURS, {}))) for arm in arms],
            left=2,
        ),
        "## Colour, predicted before seen\n",
        markdown(
            ("sequence", "model", "AUSE", "Spearman", "p10", "partial", "AUROC bad"),
            [(arm.sequence, arm.model, *_cells(arm.color.get(OURS, {}))) for arm in arms],
            left=2,
        ),
        f"## What is to be had for less: AUSE of depth, model {MODELS[0]}\n",
        markdown(
            ("sequence", *(first[0].depth if first else ())),
            [(arm.sequence, *(_n(scores.get("ause"), 2) for scores in arm.depth.values())) for arm in first],
            left=2,
        ),
        "![sparsification](sparsification.png)\n",
    ]
    if calibration:
        rows = [(name, f"{100 * value:.0f} %") for name, value in calibration.items()]
        parts += [
            "## Calibration: error of the expected error, fitted to the other sequences\n",
            markdown(("sequence", "of the mean error"), rows, left=2),
            "![reliability](reliability.png)\n",
        ]
    events = [
        (arm.sequence, arm.model, str(event["name"]), f"{event['first']} to {event['last']}", *_reacted(event))
        for arm in arms
        for event in arm.events
    ]
    if events:
        levels = ("of", "before", "lowest", "drops after", "back after", "change", "just after")
        head = ("sequence", "model", "event", "frames", *levels)
        parts += ["## What happens, and what confidence does: mean over a region or the picture\n"]
        parts += [markdown(head, events, left=2)]
    crossed = [(arm.sequence, arm.model, *_passed(arm.crossing)) for arm in arms if arm.crossing]
    if crossed:
        parts += [
            "## Somebody walks about: the places that he hides, 5 cm apart; time out of the picture does not count\n",
            markdown(
                (
                    "sequence",
                    "model",
                    "hidden",
                    "dropped",
                    "after frames",
                    "of these left",
                    "recovered",
                    "after frames",
                ),
                crossed,
                left=2,
            ),
        ]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _cells(scores: Mapping[str, float | None]) -> tuple[str, ...]:
    return tuple(_n(scores.get(name), 2) for name in ("ause", "spearman", "spearman_p10", "partial_spearman", "auroc"))


def _reacted(event: Mapping[str, object]) -> tuple[str, ...]:
    levels = (_n(event.get(name), 2) for name in ("before", "lowest"))
    times = ("-" if event.get(name) is None else str(event[name]) for name in ("time_to_drop", "time_to_recover"))
    return (str(event["of"]), *levels, *times, _n(event.get("change"), 3), _n(event.get("back"), 2))


def _passed(told: Mapping[str, float | None]) -> tuple[str, ...]:
    """The cells of a `Crossing`."""
    shares = []
    for count, of in (("dropped", "places"), ("recovered", "left")):
        share, time = (
            _share(told[count], told[of]),
            _n(told["time_to_drop" if count == "dropped" else "time_to_recover"], 0),
        )
        shares.append((share, time))
    (dropped, drop), (recovered, recover) = shares
    return (f"{told['places']}", dropped, drop, f"{told['left']}", recovered, recover)


def _share(count: float | None, of: float | None) -> str:
    return f"{100 * count / of:.0f} %" if count is not None and of else "-"


def _n(value: object, decimals: int = 3) -> str:
    return f"{value:.{decimals}f}" if isinstance(value, int | float) else "-"
