"""The same at 640x480: the whole system on the synthetic apartment, drawn at two sizes along the same walk.

The sequences are made once, some minutes for the larger one, and kept beside each other in one folder.
"""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from tcgsplat import open_rasterizer
from tcgsplat.cli.bench.track import Timed, accuracy, measured, table
from tcgsplat.cli.progress import counting
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine
from tcgsplat.datasets.synthetic import SynthConfig, synthesize
from tcgsplat.errors import TCGSplatError
from tcgsplat.storage import atomic


@dataclass(frozen=True)
class Args:
    """Make the sequences that are not there yet, and run on each."""

    out: Path = Path("runs/full_resolution")
    """Folder of the sequences, each in a folder with the name of its size."""
    sizes: tuple[str, ...] = ("320x240", "640x480")
    """Sizes of the images, pixels."""
    frames: int = 600
    """Of the whole walk; with fewer, the camera moves faster."""
    limit: int | None = 200
    """Run on no more than so many frames, from the first on."""
    preset: str = "default"
    """Of the settings."""
    json: Path | None = None
    """File to write the figures to."""


def main(args: Args) -> int:
    print(f"synthetic apartment, {args.frames} frames; {machine()}; preset {args.preset}")
    results = {}
    for size in args.sizes:
        try:
            timed, error = run(sequence(args.out, size, args.frames), args)
        except (TCGSplatError, ValueError) as problem:
            sys.stderr.write(f"full_resolution: {problem}\n")
            return 1
        print(f"\n{size}, {len(timed.seconds)} frames: ATE {accuracy(error)}; {timed.lost} lost")
        print(table(timed), flush=True)
        spreads = {stage: asdict(spread) for stage, spread in timed.milliseconds().items()}
        results[size] = {"ate_rmse_cm": error, "lost": timed.lost, "milliseconds": spreads}
    if args.json is not None:
        atomic.write_text(args.json, json.dumps({"machine": machine(), **results}, indent=2) + "\n")
    return 0


def sequence(out: Path, size: str, frames: int) -> Path:
    """The folder of one size, made if it is not there.

    Raises:
        ValueError: if the size is not two numbers.
    """
    width, _, height = size.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise ValueError(f"--sizes: {size} is not a size; write it like 640x480")
    folder = out / size
    if not folder.exists():
        out.mkdir(parents=True, exist_ok=True)
        with counting(f"{size}: frame") as progress:
            synthesize(folder, SynthConfig(frames, int(width), int(height)), progress)
    return folder


def run(folder: Path, args: Args) -> tuple[Timed, float | None]:
    """What the system did, and its ATE in cm."""
    recorded = Part(limit=args.limit).open(folder)
    timed = measured(recorded, resolved(args.preset, None, {}, None), open_rasterizer("auto"))
    return timed, timed.ate_cm(recorded.ground_truth())


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
