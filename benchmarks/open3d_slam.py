"""Open3D's dense SLAM beside ours: the same frames of one folder, on the same cores, one after the other, one table.

What a person with a CPU could use instead is the TSDF system that Open3D ships (`open3d.t.pipelines.slam`): it
integrates every frame into a voxel grid and tracks the next one against a view of the grid, by depth alone.

Both read the same undistorted images through `tcgsplat.open_sequence` and run in a process of their own.
"""

import importlib.util
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from tcgsplat import datasets, open_rasterizer
from tcgsplat.cli.bench.track import Spread, Timed, measured, waiting
from tcgsplat.cli.main import ENVIRONMENT
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine
from tcgsplat.errors import TCGSplatError
from tcgsplat.storage import atomic

DEPTH_SCALE = 5000.0
"""Units per metre of the 16-bit depth that Open3D is given: the finest in use, exact for TUM's own images."""


@dataclass(frozen=True)
class Args:
    """Run both systems on a recorded sequence with ground truth."""

    folder: tyro.conf.Positional[Path]
    """The sequence."""
    limit: int | None = None
    """Use no more than so many frames."""
    cores: int | None = None
    """Let both use only so many cores, the same ones; all that there are if left out."""
    preset: str = "default"
    """Of our settings."""
    voxel: float = 5.0 / 512
    """Edge of Open3D's voxels, metres; finer is slower."""
    far: float = 4.0
    """Depth beyond this is left out by Open3D, metres."""
    json: Path | None = None
    """File to write the figures to."""


def main(args: Args) -> int:
    if importlib.util.find_spec("open3d") is None:
        return complain(
            "open3d is not installed for this Python; run `python -m pip install -c constraints.txt open3d-cpu`, best "
            "in an environment of its own that has tcgsplat too"
        )
    try:
        if args.cores is not None:
            use_cores(args.cores)
        sequence = part(args)
        truth = sequence.ground_truth()
        theirs = alone(open3d_dense_slam, args)
        os.environ.update(ENVIRONMENT)  # ours alone, as its command does; Open3D runs as it comes
        results = {"Open3D dense SLAM": theirs, "tcgsplat": alone(tcgsplat, args)}
    except TCGSplatError as error:
        return complain(str(error))
    camera = sequence.camera
    print(f"{sequence.name}, {camera.width}x{camera.height}, {len(theirs.seconds)} frames; {machine()} for each")
    print(table({name: figures(timed, truth) for name, timed in results.items()}))
    print(
        "ms a frame, without the first one; what is left to do after the last frame is in the means.\n"
        "images at hand: the system's own time; a thread that decodes the next images runs beside it on these cores.\n"
        "with reading: the same and waiting for images. ATE: after rigid alignment, no scale.\n"
        f"Open3D: voxels of {1000 * args.voxel:.1f} mm, depth up to {args.far:g} m. tcgsplat: preset {args.preset}."
    )
    if args.json is not None:
        written = {name: figures(timed, truth) for name, timed in results.items()}
        atomic.write_text(args.json, json.dumps({"machine": machine(), **written}, indent=2) + "\n")
    return 0


def complain(sentence: str) -> int:
    sys.stderr.write(f"open3d_slam: {sentence}\n")
    return 1


def use_cores(count: int) -> None:
    """Let this process, and those that it starts, use the first cores only of those that it may use.

    Raises:
        TCGSplatError: if there are not as many, or this system cannot do so.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise TCGSplatError("--cores works on Linux only; leave it out")
    available = sorted(os.sched_getaffinity(0))
    if not 1 <= count <= len(available):
        raise TCGSplatError(f"--cores is {count}; there are {len(available)} to choose from")
    os.sched_setaffinity(0, available[:count])


def part(args: Args) -> datasets.Sequence:
    return Part(limit=args.limit).open(args.folder)


def alone(system: Callable[[Args], Timed], args: Args) -> Timed:
    """What a system did in a fresh process: no threads, caches or settings of another library stand beside it."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        poses, timed = process.submit(numbers, system, args).result()
    return replace(timed, T_world_cam={index: torch.from_numpy(T) for index, T in poses.items()})


def numbers(system: Callable[[Args], Timed], args: Args) -> tuple[dict[int, np.ndarray], Timed]:
    """The same with poses as arrays, which travel between processes by value."""
    timed = system(args)
    return {index: np.array(T) for index, T in timed.T_world_cam.items()}, replace(timed, T_world_cam={})


def tcgsplat(args: Args) -> Timed:
    return measured(part(args), resolved(args.preset, None, {}, None), open_rasterizer("auto"))


def open3d_dense_slam(args: Args) -> Timed:
    """Frame-to-model tracking by point-to-plane distances, TSDF integration and ray casting, with Open3D's defaults."""
    import open3d as o3d  # noqa: PLC0415  our own process does without

    torch.set_num_threads(1)
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    sequence = part(args)
    camera, device = sequence.camera, o3d.core.Device("CPU:0")
    K = o3d.core.Tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    T_world_cam = o3d.core.Tensor(np.eye(4))
    model = o3d.t.pipelines.slam.Model(args.voxel, 16, 20_000, T_world_cam, device)
    seen, cast = (o3d.t.pipelines.slam.Frame(camera.height, camera.width, K, device) for _ in range(2))
    poses, seconds, lost = {}, [], 0
    for frame, waited in waiting(sequence):
        color = o3d.t.geometry.Image((255 * frame.color).round().byte().numpy())
        depth = (DEPTH_SCALE * frame.depth).round().clamp_max(65535).numpy().astype(np.uint16)
        depth = o3d.t.geometry.Image(depth)
        started = time.perf_counter()  # what is above is our images made Open3D's, and is on nobody's account
        seen.set_data_from_image("color", color)
        seen.set_data_from_image("depth", depth)
        if poses:
            try:
                moved = model.track_frame_to_model(seen, cast, DEPTH_SCALE, args.far, 0.07)
                T_world_cam = T_world_cam @ moved.transformation
            except RuntimeError:  # it found no pose: the last one stays
                lost += 1
        tracked = time.perf_counter()
        model.update_frame_pose(len(poses), T_world_cam)
        model.integrate(seen, DEPTH_SCALE, args.far, 8.0)
        model.synthesize_model_frame(cast, DEPTH_SCALE, 0.1, args.far, 8.0, False)
        mapped = time.perf_counter()
        poses[frame.index] = torch.from_numpy(T_world_cam.numpy().copy())
        seconds.append(
            {"load": waited, "track": tracked - started, "map": mapped - tracked, "frame": waited + mapped - started}
        )
    return Timed(poses, seconds, lost)


def figures(timed: Timed, truth: Mapping[int, torch.Tensor]) -> dict[str, float | None]:
    """Error in cm and milliseconds a frame."""
    rows = timed.seconds[1:] or timed.seconds
    at_hand = Spread.of(row["frame"] - row["load"] for row in rows)
    finish = 1000 * timed.finish / len(rows)
    return {
        "ate_rmse_cm": timed.ate_cm(truth),
        "lost": timed.lost,
        **{f"ms_{name}": ms for name, ms in asdict(at_hand).items()},
        "ms_mean": at_hand.mean + finish,
        "ms_mean_with_reading": Spread.of(row["frame"] for row in rows).mean + finish,
    }


def table(results: Mapping[str, Mapping[str, float | None]]) -> str:
    lines = [
        f"{'':<19}{'':>10}{'images at hand':>27}{'with reading':>14}",
        f"{'':<19}{'ATE, cm':>10}{'mean':>9}{'median':>9}{'95 %':>9}{'mean':>14}{'lost':>6}",
    ]
    for name, f in results.items():
        error = "unknown" if f["ate_rmse_cm"] is None else f"{f['ate_rmse_cm']:.2f}"
        times = f"{f['ms_mean']:>9.1f}{f['ms_median']:>9.1f}{f['ms_percentile_95']:>9.1f}"
        lines.append(f"{name:<19}{error:>10}{times}{f['ms_mean_with_reading']:>14.1f}{f['lost']:>6}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
