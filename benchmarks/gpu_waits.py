"""What a mapping step and the paper's solver wait for on a GPU, by torch's own account; needs one.

    python benchmarks/gpu_waits.py

Each wait is printed once, with the line that asks for it. Two are known for all steps of mapping together: how many
pairs of splat and tile the first of them has, and whether all had room. For the solver's, so are the way there of the
guess, and back of pose and loss.
"""

import sys
import warnings
from collections import Counter

import torch

from tcgsplat.cli.bench.contenders import Ours, Scene
from tcgsplat.cli.bench.render import Size
from tcgsplat.render.backends import open_rasterizer

STEPS = 20


def main() -> int:
    """Print the waits of so many steps of each."""
    rasterizer = open_rasterizer("cuda")
    ours = Ours(Scene.of(Size(640, 480, 150_000), rasterizer), rasterizer)
    for name, work in (("mapping", ours.map), ("tracking", ours.track)):
        work(2)  # what is done once is done
        torch.cuda.set_sync_debug_mode("warn")
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            work(STEPS)
        torch.cuda.set_sync_debug_mode("default")
        places = Counter(f"{wait.filename}:{wait.lineno}" for wait in waits)
        print(f"{name}, {STEPS} steps: {sum(places.values())} waits")
        for place, count in places.most_common():
            print(f"  {count:4d}  {place}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
