"""How well pictures are found in a finished map: share within 2 cm and 1 degree, and poses that are wrong.

Every other frame of a sequence is mapped, and the frames between them are looked up: with their depth, and without it.
What is no picture of the place must not be found at all. Runs are kept, and used again.
"""

import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
import tyro

from tcgsplat import open_rasterizer, open_sequence
from tcgsplat.cli.pictures import relocalizer
from tcgsplat.cli.progress import counting
from tcgsplat.cli.recorder import Part, begin, recorded
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine
from tcgsplat.datasets.synthetic import SynthConfig, synthesize
from tcgsplat.errors import TCGSplatError
from tcgsplat.evaluation.ate import align, positions
from tcgsplat.geometry import se3
from tcgsplat.loop.relocalization import Relocalizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.storage import atomic
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Pose

NEAR = (2.0, 1.0)
"""Centimetres and degrees within which a picture counts as localised."""
WRONG = (5.0, 3.0)
"""Centimetres and degrees from which on it should rather not have been found."""


@dataclass(frozen=True)
class Args:
    """Map every other frame of sequences, and look the others up; and pictures of other places."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Sequences with ground truth; the synthetic apartment, clean and with a Kinect's noise, if none is given."""
    strangers: tuple[Path, ...] = ()
    """Sequences of other places, to be looked up in every map."""
    out: Path = Path("runs/localization")
    """Folder of the runs, and of the sequences that are made."""
    every: int = 1
    """Look up only every so many-th of the frames between those that were mapped."""
    strangers_every: int = 8
    """And every so many-th frame of the other places."""
    json: Path | None = None
    """File to write the figures to."""


@dataclass(frozen=True)
class Lookup:
    """A picture that was found."""

    frame: int
    """Its index in the whole sequence."""
    submap: int
    centimeters: float
    """From the truth, once the run's path is aligned to it; NaN for a picture of another place."""
    degrees: float

    def within(self, limits: tuple[float, float]) -> bool:
        """Nearer to the truth than so many centimetres and degrees."""
        return self.centimeters < limits[0] and self.degrees < limits[1]


@dataclass(frozen=True)
class Line:
    """One line of the table."""

    map: str
    pictures: str
    looked_up: int
    found: tuple[Lookup, ...]

    @property
    def near(self) -> float:
        """Percent of the pictures that are localised."""
        return 100 * sum(one.within(NEAR) for one in self.found) / max(self.looked_up, 1)

    @property
    def wrong(self) -> list[Lookup]:
        """Poses that should not have been given."""
        return [one for one in self.found if not one.within(WRONG)]

    def __str__(self) -> str:
        errors = sorted(one.centimeters for one in self.found)
        middle = f"{errors[len(errors) // 2]:.2f}" if errors and not math.isnan(errors[0]) else "-"
        return (
            f"{self.map:<18}{self.pictures:<34}{self.looked_up:>8}{len(self.found):>7}"
            f"{self.near:>8.1f}{middle:>11}{len(self.wrong):>7}"
        )


HEAD = f"{'map':<18}{'pictures':<34}{'looked up':>8}{'found':>6}{'near %':>8}{'median cm':>11}{'wrong':>7}"


def main(args: Args) -> int:
    torch.set_num_threads(1)  # as in a run
    rasterizer = open_rasterizer("auto")
    print(f"near: within {NEAR[0]:g} cm and {NEAR[1]:g} degree; wrong: not within {WRONG[0]:g} cm and {WRONG[1]:g}")
    print(f"degrees, or of another place; {machine()}\n\n{HEAD}", flush=True)
    lines = []
    try:
        for folder in args.folders or made(args.out):
            for line in measured(folder, args, rasterizer):
                print(line, flush=True)
                for one in line.wrong:
                    print(f"  wrong: {one}", flush=True)
                lines.append(line)
    except TCGSplatError as problem:
        sys.stderr.write(f"localization: {problem}\n")
        return 1
    if args.json is not None:
        figures = [asdict(line) | {"near": line.near, "wrong": len(line.wrong)} for line in lines]
        atomic.write_text(args.json, json.dumps({"machine": machine(), "lines": figures}, indent=2) + "\n")
    return 0


def made(out: Path) -> list[Path]:
    """The synthetic sequences, made if they are not there."""
    folders = []
    for name, config in {"clean": SynthConfig(), "kinect": SynthConfig(depth_noise=True)}.items():
        folders.append(out / "sequences" / name)
        if not folders[-1].exists():
            folders[-1].parent.mkdir(parents=True, exist_ok=True)
            with counting(f"{name}: frame") as progress:
                synthesize(folders[-1], config, progress)
    return folders


def measured(folder: Path, args: Args, rasterizer: Rasterizer) -> Iterable[Line]:
    """The lines of one map.

    Raises:
        TCGSplatError: if a sequence cannot be read, or has no ground truth.
    """
    run = mapped(folder, args.out / folder.name, rasterizer)
    known, T_truth_world = relocalizer(run, rasterizer), alignment(run, folder)
    T_world_map = run.trajectory()[1].T_world_map
    between = open_sequence(folder, start=1, stride=2 * args.every)
    truth = between.ground_truth()
    indices = {i: 1 + 2 * args.every * i for i in range(len(between))}
    for what, bare in (("between, with depth", False), ("between, bare", True)):
        with counting(f"{run.path.name}, {what}") as tell:
            found = []
            for frame in between:
                tell(frame.index, len(between))
                seen = located(known, T_world_map, frame, bare)
                if seen is not None and frame.index in truth:
                    found.append(lookup(indices[frame.index], seen, T_truth_world, truth[frame.index]))
        yield Line(run.path.name, what, len(truth), tuple(found))
    for place in args.strangers:
        strange = open_sequence(place, stride=args.strangers_every)
        for what, bare in (("with depth", False), ("bare", True)):
            with counting(f"{run.path.name}, {place.name}") as tell:
                found = []
                for frame in strange:
                    tell(frame.index, len(strange))
                    seen = located(known, T_world_map, frame, bare)
                    if seen is not None:
                        found.append(Lookup(frame.index * args.strangers_every, seen[0], math.nan, math.nan))
            yield Line(run.path.name, f"{place.name}, {what}", len(strange), tuple(found))


def mapped(folder: Path, out: Path, rasterizer: Rasterizer) -> RunDirectory:
    """The run over every other frame, made if it is not there."""
    if not (out / "summary.json").exists():
        config, part = resolved("default", None, {}, None), Part(stride=2)
        recorded(part.open(folder), config, rasterizer, begin(out, config, folder, part, overwrite=True), "default")
    return RunDirectory.open(out)


def alignment(run: RunDirectory, folder: Path) -> Pose:
    """Rigid motion from the run's world to that of the truth, by the path of the frames that were mapped."""
    trajectory, atlas = run.trajectory()
    truth = Part.of(run).open(folder).ground_truth()
    pairs = [
        (T, truth[row.frame_index])
        for row, T in zip(trajectory.rows, trajectory.world(atlas), strict=True)
        if row.frame_index in truth and not row.lost
    ]
    fit = align(positions([ours for ours, _ in pairs]), positions([theirs for _, theirs in pairs]))
    T = se3.identity()
    T[:3, :3], T[:3, 3] = torch.from_numpy(fit.rotation), torch.from_numpy(fit.translation)
    return T


def located(known: Relocalizer, T_world_map: Sequence[Pose], frame: Frame, bare: bool) -> tuple[int, Pose] | None:
    """The submap in which a picture was found, and its pose in the run's world."""
    found = known.relocalized(replace(frame, depth=torch.zeros_like(frame.depth)) if bare else frame, T_world_map)
    if found is None:
        return None
    index = found.reference.index
    return index, T_world_map[index] @ found.tracked.T_map_cam


def lookup(index: int, seen: tuple[int, Pose], T_truth_world: Pose, truth: Pose) -> Lookup:
    """How far off it is."""
    submap, T_world_cam = seen
    apart = se3.inverse(truth) @ T_truth_world @ T_world_cam
    return Lookup(index, submap, 100 * se3.translation_norm(apart), math.degrees(se3.rotation_angle(apart)))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
