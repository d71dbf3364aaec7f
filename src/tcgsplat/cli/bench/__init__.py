"""`tcgsplat bench`: how long the stages take on this machine, what confidence is worth, and the paper's tables."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tcgsplat.cli.flags import Flags
from tcgsplat.cli.usage import UsageError


@dataclass(frozen=True)
class Render:
    """Time an iteration of mapping on the CPU on random scenes of three sizes: forward, backward, Adam.

    All seven channels (colour, confidence, depth, plane depth, alpha) have a derivative, which goes to all parameters
    and to the pose; losses are not computed. Times are medians and minima in milliseconds. `iteration` is the whole,
    in runs of its own: for the times of the stages, threads must meet between them. A second table counts what each
    scene needs and says which share of the time this machine could not do without: the physical limit.
    """

    json: Path | None = None
    """File to write to: from size to numbers, by stage: `forward_ms`, `forward_min_ms`, `forward_floor_ms`."""
    repeats: int = 20
    """Timed iterations of each size, after three that are not."""
    threads: int | None = None
    """Worker threads; as many as there are cores if left out."""


@dataclass(frozen=True)
class Track:
    """Time the whole system on a recorded sequence, at the size that its images have; nothing is written down.

    In the table `load` is waiting for the reader, which decodes the next frames beside; the stages are those of the
    system, by its own names; `frame` is the whole of a frame: load, stages, and what is between them; `update` is a
    mapping update on its own thread. The first frame and update are left out: caches are cold, and the whole first view
    is mapped. Use `taskset -c 0,1 tcgsplat ...` to allow only some cores. Every setting is a
    flag, as for `tcgsplat run`.
    """

    folder: tyro.conf.Positional[Path]
    """The sequence."""
    limit: int | None = None
    """Use no more than so many frames."""
    preset: str = "default"
    """Where the settings start from: see `tcgsplat presets`."""
    config: Path | None = None
    """A TOML file of settings, such as the config.toml of a run."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""
    seed: int | None = None
    """Of all randomness; that of the preset if left out."""
    json: Path | None = None
    """File to write the figures to, with the settings in full."""


@dataclass(frozen=True)
class Ablation:
    """See what it is worth that confidence guides the system: the four rows of the paper's Table 6 (nothing; mapping;
    tracking too; loop closure too), tracking alone, loop closure alone, and three controls that guide by something
    else: the same for all Gaussians, that of others in wrong places, and one made of the true depth.

    Each is a real run for each sequence and seed; the seed draws keyframes and where Gaussians begin. The tables have
    the error of the path, and the difference to the first row with an interval. Finished runs are kept in
    OUT/ablation.json: the same command, or one with more seeds or sequences, goes on from there. Every setting is a
    flag, as for `tcgsplat run`.
    """

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """The sequences; they must have ground truth, and for the oracle a folder `truth`, as `tcgsplat synth` makes it."""
    out: Path | None = None
    """Folder for README.md, ablation.json and the figure; runs/ablation-NAMES if left out, with those of sequences."""
    arms: tuple[str, ...] = ()
    """Only these, and I: I, II, III, IV, tracking, loop, constant, shuffled, oracle."""
    seeds: int = 3
    """Runs of each arm on each sequence."""
    seed: int | None = None
    """The first seed, the others follow it; that of the preset if left out."""
    preset: str = "default"
    """Where the settings start from: see `tcgsplat presets`."""
    config: Path | None = None
    """A TOML file of settings, such as the config.toml of a run."""
    start: int = 0
    """First frame, counted from 0."""
    stride: int = 1
    """Use every so many-th frame."""
    limit: int | None = None
    """Use no more than so many frames."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""


@dataclass(frozen=True)
class Loops:
    """Time how long it takes to compare a finished submap with those before it, by how many these are.

    Every submap of the run is compared again, one after another, with nothing else going on. Times are means of the
    last five comparisons, in milliseconds.
    """

    run: tyro.conf.Positional[Path | None] = None
    """A run directory; if left out, a walk through two synthetic rooms is made and mapped: some two minutes."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""
    json: Path | None = None
    """File to write the figures to."""


@dataclass(frozen=True)
class Gpu:
    """Time what a GPU is for: an iteration of tracking and of mapping on random scenes, through our rasterizers and by
    a bare loop of gsplat, in turn; and the whole system on a synthetic apartment, with its error and its memory.

    The page is printed and goes to OUT/README.md, all figures to OUT/gpu.json, as they come. Every setting is a flag,
    as for `tcgsplat run`, for the whole system.
    """

    backends: tuple[str, ...] = ()
    """Rasterizers to time, the first of them end to end too; if left out, cuda and, where it is installed, gsplat."""
    sizes: tuple[str, ...] = ("640x480x150000", "640x480x600000", "1200x680x150000", "1200x680x600000")
    """Of the random scenes: width, height, Gaussians; none to leave them out."""
    bare: bool = True
    """Leave out gsplat alone, which is timed beside them if it is installed; it compiles for minutes at first."""
    repeats: int = 10
    """Timed runs of each contender on each scene."""
    steps: int = 60
    """Iterations of a run."""
    presets: tuple[str, ...] = ("default", "paper-replica", "paper-tum", "paper-scannet")
    """To run end to end; the first one on the CPU as well."""
    frames: int = 300
    """Of the synthetic sequence; 0 to leave it out."""
    width: int = 640
    """Pixels across of the synthetic sequence; the height is three quarters of it."""
    config: Path | None = None
    """A TOML file of settings over all presets."""
    seed: int | None = None
    """Of all randomness; that of the preset if left out."""
    out: Path | None = None
    """Folder for README.md, gpu.json and data/; runs/bench-gpu if left out."""


@dataclass(frozen=True)
class Confidence:
    """See whether confidence is true: what the map claims of a frame before it has seen it, against the true depth.

    Every sequence is gone through twice, with our model of confidence and with the paper's. Sequences need a
    folder `truth`, as `tcgsplat synth` makes it. A page with tables and plots, and all figures, go to OUT. Every
    setting is a flag, as for `tcgsplat run`.
    """

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """The sequences; calibration is judged between them, so two or more tell more."""
    out: Path | None = None
    """Folder for README.md, confidence.json and the plots; runs/confidence if left out."""
    every: int = 5
    """Predict every so many-th frame."""
    seed: int | None = None
    """Of all randomness; that of the preset if left out."""
    preset: str = "default"
    """Where the settings start from: see `tcgsplat presets`."""
    config: Path | None = None
    """A TOML file of settings, such as the config.toml of a run."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""


@dataclass(frozen=True, kw_only=True)
class SuiteArgs:
    """What all suites take."""

    out: Path | None = None
    """Folder for README.md, results.json, the figures and runs/; runs/bench-SUITE if left out."""
    sequences: tuple[str, ...] = ()
    """Only these of the suite."""
    presets: tuple[str, ...] = ("default", "base")
    """To compare: see `tcgsplat presets`; all others are compared with the last."""
    seeds: int = 2
    """Runs of each preset on each sequence."""
    seed: int | None = None
    """The first seed, the others follow it; that of the preset if left out."""
    config: Path | None = None
    """A TOML file of settings over all presets."""
    limit: int | None = None
    """Use no more than so many frames of each sequence."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""
    lpips: Path | None = None
    """Weights for LPIPS, as for `tcgsplat eval`."""
    refine: int = 3
    """Refine the one map by so many steps a keyframe before it is scored, as `tcgsplat refine` does; 0 to score it as
    the submaps merge. The published pictures are of a map of its own, which was trained offline by 30000 steps."""
    cluster: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[ADDRESS]")] = None
    """Spread the runs over a Ray cluster: that at ADDRESS, or one started on this machine if it is left out or
    `local`. A worker that dies costs one run, which is tried again. Times are then those of whatever machine it was."""


@dataclass(frozen=True, kw_only=True)
class Synthetic(SuiteArgs):
    """Make four recordings of the synthetic apartment (exact; depth as from a Kinect; with somebody walking about;
    with jumps of brightness), run each preset on each with each seed, and write a page of tables and figures: path,
    views, surface, times, whether confidence helps, and whether it is true.

    The data is made in OUT/data. What is finished is kept: the same command, or one with more seeds, goes on from
    there. Ctrl-C keeps what is finished. Every setting is a flag, as for `tcgsplat run`.
    """

    frames: int = 300
    """Of each sequence."""
    width: int = 320
    """Pixels across; the height is three quarters of it."""


@dataclass(frozen=True, kw_only=True)
class Recorded(SuiteArgs):
    """What suites of recorded sequences take."""

    data: Path
    """Folder that holds the folders of the sequences."""


@dataclass(frozen=True, kw_only=True)
class Tum(Recorded):
    """Run the five sequences of the paper's Table 3: DATA/rgbd_dataset_freiburg1_desk, ...1_desk2, ...1_room, ...2_xyz
    and ...3_long_office_household. Those that are not there are named and left out. As `bench synthetic`.
    """


@dataclass(frozen=True, kw_only=True)
class Replica(Recorded):
    """Run the eight sequences of the paper's Tables 1 and 4: DATA/room0 to room2 and office0 to office4, as NICE-SLAM
    distributes them. Those that are not there are named and left out. As `bench synthetic`.
    """


@dataclass(frozen=True, kw_only=True)
class Scannet(Recorded):
    """Run the six scenes of the paper's Table 2: DATA/scene0000_00, 0059, 0106, 0169, 0181 and 0207, as ScanNet's own
    tool extracts them. Those that are not there are named and left out. As `bench synthetic`.
    """


@dataclass(frozen=True)
class Args:
    """Time the mapping's kernels on random scenes, the whole system on a recorded sequence, loop closure, or a GPU; see
    whether it helps that confidence guides the system, and whether it is true; or run a suite of sequences, and write
    the paper's tables of it: synthetic, tum, replica or scannet.
    """

    what: tyro.conf.OmitSubcommandPrefixes[
        tyro.conf.OmitArgPrefixes[
            Annotated[Render, tyro.conf.subcommand("render")]
            | Annotated[Track, tyro.conf.subcommand("track")]
            | Annotated[Loops, tyro.conf.subcommand("loops")]
            | Annotated[Gpu, tyro.conf.subcommand("gpu")]
            | Annotated[Ablation, tyro.conf.subcommand("ablation")]
            | Annotated[Synthetic, tyro.conf.subcommand("synthetic")]
            | Annotated[Tum, tyro.conf.subcommand("tum")]
            | Annotated[Replica, tyro.conf.subcommand("replica")]
            | Annotated[Scannet, tyro.conf.subcommand("scannet")]
            | Annotated[Confidence, tyro.conf.subcommand("confidence")]
        ]
    ]
    settings: Flags = field(default_factory=dict)
    """Put here from the flags with a dot."""


def command(args: Args) -> int:
    """Print tables, and write the files that were asked for."""
    if isinstance(args.what, Track):
        from tcgsplat.cli.bench import track

        return track.command(args.what, args.settings)
    if isinstance(args.what, Ablation):
        from tcgsplat.cli.bench import ablation

        return ablation.command(args.what, args.settings)
    if isinstance(args.what, Confidence):
        from tcgsplat.cli.bench import confidence

        return confidence.command(args.what, args.settings)
    if isinstance(args.what, Gpu):
        from tcgsplat.cli.bench import gpu

        return gpu.command(args.what, args.settings)
    if isinstance(args.what, SuiteArgs):
        from tcgsplat.cli.bench import suite

        return suite.command(args.what, args.settings)
    if args.settings:
        raise UsageError(f"this bench has no settings, but --{next(iter(args.settings))} was given; leave it out")
    if isinstance(args.what, Loops):
        from tcgsplat.cli.bench import loops

        return loops.command(args.what)
    from tcgsplat.cli.bench import render

    return render.command(args.what)
