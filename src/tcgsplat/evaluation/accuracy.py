"""How true a path is: errors of position and of motion against ground truth, of a run or of any system's file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tcgsplat.datasets.association import MAX_GAP, nearest
from tcgsplat.datasets.sequence import Sequence as RgbdSequence
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import ate, rpe
from tcgsplat.evaluation.metrics import Metric, Report, Row
from tcgsplat.scene.trajectory import parse_tum
from tcgsplat.tensors import Pose

Times = Float[np.ndarray, " n"]
"""Time stamps, seconds."""

ALIGNMENT = (
    "ate: rigid alignment without scale, ate_rmse_sim3 with it; rpe: from one pose to the next, _1s: to the one a "
    "second later"
)
"""How a path and the truth are compared."""


def accuracy(estimated: Sequence[Pose], truth: Sequence[Pose], times: Times) -> dict[str, Row]:
    """The errors of a path.

    - `ate_rmse`, `ate_rmse_sim3` (cm): of camera centres, after rigid alignment and after that by a similarity.
    - `rpe_translation` (cm), `rpe_rotation` (deg): of the motion from one pose to the next; `rpe_translation_1s` and
      `rpe_rotation_1s`: from each pose to that which is nearest to one second later.

    Args:
        estimated: `T_world_cam`, row i belongs to row i of `truth`.
        truth: `T_world_cam`, in any other world frame.
        times: Of the rows, increasing.

    Returns:
        All of these, each a metric or why there is none.
    """
    names = ("ate_rmse", "ate_rmse_sim3", "rpe_translation", "rpe_rotation", "rpe_translation_1s", "rpe_rotation_1s")
    if len(truth) < 3:
        return dict.fromkeys(names, f"only {len(truth)} frames have a true pose" if len(truth) else "no ground truth")
    errors = [ate.ate_rmse_of_poses(estimated, truth, with_scale=with_scale) for with_scale in (False, True)]
    rows: list[Row] = [Metric(100.0 * error, "cm") for error in errors]
    for pairs in (rpe.successive(len(truth)), rpe.apart(times, 1.0)):
        if not len(pairs):
            rows += ["no two poses are a second apart"] * 2
            continue
        error = rpe.rpe_rmse(estimated, truth, pairs)
        rows += [Metric(100.0 * error.translation, "cm"), Metric(error.rotation, "deg")]
    return dict(zip(names, rows, strict=True))


def score_trajectory(estimated: Path, sequence: RgbdSequence) -> Report:
    """Score a trajectory of any system, given as text in the TUM format, against a sequence's ground truth.

    A pose belongs to the frame whose time stamp is nearest, within 20 ms; of several, the nearest one. Decodes the
    sequence once, for its time stamps.

    Args:
        estimated: File of `timestamp tx ty tz qx qy qz qw`, camera to world.
        sequence: The data with its ground truth.

    Returns:
        The rows of `accuracy`, `ate_max` (cm), `frames_tracked` (%), the share of the sequence's frames that have a
        pose, and `frames`, those compared.

    Raises:
        EvaluationError: if the file cannot be read, there is no ground truth, or fewer than three poses match.
    """
    try:
        stamps, poses = parse_tum(estimated.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise EvaluationError(f"cannot read {estimated} ({error}); give a trajectory in the TUM format") from error
    truth = sequence.ground_truth()
    if not truth:
        raise EvaluationError(f"the sequence {sequence.name} has no ground truth to compare {estimated} with")
    frames = [(frame.index, frame.timestamp) for frame in sequence]
    posed = [(*frames[j], poses[i]) for i, j in associate(np.array(stamps), np.array([stamp for _, stamp in frames]))]
    known = [(truth[index], stamp, T) for index, stamp, T in posed if index in truth]
    if len(known) < 3:
        raise EvaluationError(
            f"only {len(known)} of {len(poses)} poses in {estimated} are within {1000 * MAX_GAP:.0f} ms of a frame of "
            f"{sequence.name} with a true pose; check that its time stamps are seconds of the same clock"
        )
    true, times, T_world_cam = zip(*known, strict=True)
    errors = ate.errors(ate.positions(T_world_cam), ate.positions(true))
    rows = {
        **accuracy(T_world_cam, true, np.array(times)),
        "ate_max": Metric(100.0 * float(errors.max()), "cm"),
        "frames_tracked": Metric(100.0 * len(posed) / len(frames), "%"),
        "frames": Metric(len(known)),
    }
    with_truth = sum(index in truth for index, _ in frames)
    told = f"{len(known)} of its {len(poses)} poses, against {with_truth} frames with a true pose; {ALIGNMENT}"
    return Report.of(rows, {"sequence": sequence.name, "trajectory": f"{estimated}: {told}"})


def associate(times: Times, others: Float[np.ndarray, " m"], *, max_gap: float = MAX_GAP) -> list[tuple[int, int]]:
    """Pairs (i, j) such that j is the other time nearest to time i, at most `max_gap` seconds away.

    Each j is given once, to the nearest i; pairs come in the order of j. Neither list need be sorted.
    """
    if len(times) == 0 or len(others) == 0:
        return []
    order = np.argsort(others, kind="stable")
    places, gaps = nearest(times, others[order])
    best: dict[int, int] = {}
    for i in np.argsort(gaps, kind="stable")[: int((gaps <= max_gap).sum())].tolist():
        best.setdefault(int(order[places[i]]), i)
    return [(best[j], j) for j in sorted(best)]
