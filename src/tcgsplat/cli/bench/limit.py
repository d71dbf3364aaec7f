"""The physical limit of mapping's stages: the least time in which this machine could do what a scene needs.

Blending is bound by arithmetic. What it needs is counted on the very scene (`Needs`), in vectors of sixteen pixels,
the 4 x 4 blocks that a splat's ellipse touches; each takes a known number of instructions of the multiply-add pipes:

    forward  >= FORWARD_OPERATIONS * blocks / (rate * threads)
    backward >= BACKWARD_OPERATIONS * blocks / (rate * threads) + TREE_CYCLES * pairs / (clock * threads)

with the vector rate and the clock that `probes` measured on one thread. The count is of the task, five composited
channels (colour, confidence, one depth), and not of our kernels, which composite seven: compositing more, testing
ellipses, making lists, reading memory and guessing branches wrong is what the share that is missing to 100 % pays for.

Stages that go over rows of splats are bound by memory: bytes that must be read or written, at the rate at which
copying as many bytes goes here. Sorting and binning have no floor here.
"""

from dataclasses import dataclass

from tcgsplat.cli.bench import probes
from tcgsplat.render.numba_cpu.layout import BLOCK_PIXELS, FEATURE, PARAMETERS, RECORD
from tcgsplat.render.numba_cpu.passes import Drawn
from tcgsplat.render.numba_cpu.workers import Workers

FORWARD_OPERATIONS = 15
"""To composite one block of one splat: 5 for the quadratic form (two of its seven operations are additions, which
other pipes do), 4 for a polynomial of degree four for 2^x, 1 for the weight, 5 for the channels."""
BACKWARD_OPERATIONS = 31
"""To differentiate it: 10 again up to the weight, 5 for the product with the image's derivative, 1 for what remains
behind, about 5 to divide by 1 - alpha and for the derivative by alpha, 5 for the moments of the offset, 5 for the
channels. Counted by hand, like the ones above, in the inner loop of the study that the kernels are built on."""
TREE_CYCLES = 11
"""To sum a (splat, tile) pair's eleven vectors over their lanes: 22 shuffles, two in a cycle."""

_FLOAT = 4
PROJECT_BYTES = _FLOAT * (PARAMETERS + RECORD + 1 + 4)
"""A splat: its parameters are read; its record, depth and rectangle of tiles are written."""
SUMS_BYTES = _FLOAT * (RECORD + 1)
"""A (splat, tile) pair: its sums and its place are read, in the same stage as what follows."""
STEP_BYTES = _FLOAT * (FEATURE + PARAMETERS * 6)
"""A splat: what was drawn of it, but for the features, is read; parameters and two moments are read and written."""


@dataclass(frozen=True)
class Needs:
    """What a view of a scene cannot be drawn without; see `probes.needed`."""

    splats: int
    """In the map, drawn or not."""
    pixels: int
    """(splat, pixel) pairs."""
    blocks: int
    """(splat, block of 4 x 4 pixels) pairs: vectors."""
    pairs: int
    """(splat, tile of 16 x 16 pixels) pairs."""

    @staticmethod
    def of(drawn: Drawn) -> "Needs":
        """Counted on a forward pass."""
        _, height, width = drawn.planes.shape
        pixels, blocks, pairs = probes.needed(
            drawn.tile_ends, drawn.pair_splats, drawn.records, drawn.masks, drawn.tiles_x, width, height
        )
        return Needs(drawn.padded, pixels, blocks, pairs)

    @property
    def lane_use(self) -> float:
        """Share of the vectors' lanes that are needed pixels."""
        return self.pixels / (BLOCK_PIXELS * max(self.blocks, 1))


@dataclass(frozen=True)
class Machine:
    """What this machine can do, measured."""

    threads: int
    vector_rate: float
    """Multiply-adds of sixteen lanes that one thread does in a second."""
    clock_rate: float
    """Cycles of one thread in a second."""

    @staticmethod
    def measured(threads: int) -> "Machine":
        """As this machine is now."""
        return Machine(threads, probes.vector_rate(), probes.clock_rate())

    def __str__(self) -> str:
        """One line for a person."""
        return (
            f"{self.threads} thread{'s' * (self.threads != 1)} of {self.vector_rate / 1e9:.2f} vector multiply-adds "
            f"a nanosecond and {self.clock_rate / 1e9:.2f} GHz each"
        )

    def to_dict(self) -> dict[str, float]:
        """For JSON."""
        return {"threads": self.threads, "vectors_per_second": self.vector_rate, "clock_hz": self.clock_rate}

    def stream_seconds(self, moved: int) -> float:
        """To move as many bytes, measured on arrays of that size, so that the caches help as much as they do there."""
        return moved / probes.stream_rate(moved, Workers(self.threads))


def floors(needs: Needs, machine: Machine) -> dict[str, float]:
    """Least milliseconds by stage, under the names of the stages; for those that have a floor."""
    vectors, cycles = machine.threads * machine.vector_rate, machine.threads * machine.clock_rate
    seconds = {
        "project": machine.stream_seconds(PROJECT_BYTES * needs.splats),
        "forward": FORWARD_OPERATIONS * needs.blocks / vectors,
        "backward": BACKWARD_OPERATIONS * needs.blocks / vectors + TREE_CYCLES * needs.pairs / cycles,
        "step": machine.stream_seconds(STEP_BYTES * needs.splats + SUMS_BYTES * needs.pairs),
    }
    return {stage: 1000.0 * duration for stage, duration in seconds.items()}
