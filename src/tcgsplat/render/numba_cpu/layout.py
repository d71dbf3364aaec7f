"""Memory layouts that the kernels share.

Parameters come in as one aligned float32 array [blocks, PARAMETERS, 16]: sixteen Gaussians make a block, and each of a
block's rows is one parameter of all sixteen, as a vector holds them. A block's rows lie side by side, so that a kernel
walks through memory once and not along PARAMETERS rows at a time, which no processor asks for in advance. A projected splat is a record of sixteen floats, one cache line. Images live in
tiles of 16 x 16 pixels, each tile as CHANNELS planes, each plane as sixteen blocks of 4 x 4 pixels, each block one
vector: small splats touch few blocks, and a block's lanes are used well whatever the splat's shape.
"""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Counts = npt.NDArray[np.uint32]

# Rows of a block of parameters.
MEAN, QUAT, SCALE, LOG2_OPACITY, FEATURE = 0, 3, 7, 10, 11
FEATURES = 4
PARAMETERS = FEATURE + FEATURES

# Floats of a record: the centre (px), the exponent's quadratic form in log2 units
#   log2 alpha = A dx^2 + B dx dy + C dy^2 + log2 opacity,
# its two ridge slopes (where the form is largest along a column, a row), features, depth (m) and plane slope (m/px).
U, V, FORM_A, FORM_B, FORM_C, RECORD_LOG2_OPACITY, RIDGE_Y, RIDGE_X = range(8)
RECORD_FEATURE = 8
DEPTH, SLOPE_U, SLOPE_V = 12, 13, 14
RECORD = 16

# Channels of a tile: the features, centre depth, plane depth, alpha.
CHANNELS = FEATURES + 3
TILE = 16
BLOCK = 4
BLOCK_PIXELS = BLOCK * BLOCK
TILE_PIXELS = TILE * TILE
TILE_FLOATS = CHANNELS * TILE_PIXELS

SPAN_UNIT = 1 << 12
"""A splat's rectangle of tiles is two integers: its first tile, and (columns - 1) + SPAN_UNIT * (rows - 1)."""

SPLAT = 0xFFFFFFFF
"""The lower half of a list's 64-bit entry is a splat: a sorting key over a splat, or a slot over a splat."""

# Entries of the camera vector: rotation (row by row), translation, intrinsics, limits of x/z and y/z, image limits.
ROTATION, TRANSLATION, FOCAL, CENTER, SLOPE_LIMITS, LAST_PIXEL = 0, 9, 12, 14, 16, 20
CAMERA = 22


def aligned(shape: int | tuple[int, ...], dtype: npt.DTypeLike = np.float32) -> npt.NDArray[np.generic]:
    """Uninitialised array that begins at a cache line, so that vector loads never straddle two."""
    dtype = np.dtype(dtype)
    count = int(np.prod(shape))
    raw = np.empty(count * dtype.itemsize + 64, np.uint8)
    offset = -raw.ctypes.data % 64
    return raw[offset : offset + count * dtype.itemsize].view(dtype).reshape(shape)


def to_blocks(blocks: Floats, table: npt.NDArray[np.float32]) -> None:
    """Write a table [n, k] to the first n lanes of blocks [m, k, 16]; what comes after them stays."""
    n, k = table.shape
    whole = n // 16
    blocks[:whole] = table[: 16 * whole].reshape(whole, 16, k).transpose(0, 2, 1)
    if n % 16:
        blocks[whole, :, : n % 16] = table[16 * whole :].T


def from_blocks(blocks: Floats) -> Floats:
    """The table [16 m, k] of blocks [m, k, 16], a copy."""
    m, k, _ = blocks.shape
    return blocks.transpose(0, 2, 1).copy().reshape(16 * m, k)


# Lane k of a block of pixels is pixel (k % 4, k // 4); block b of a tile begins at pixel (4 (b % 4), 4 (b // 4)).
LANE_GRID: Floats = np.concatenate(
    [
        np.arange(16) % BLOCK,
        np.arange(16) // BLOCK,
        BLOCK * (np.arange(16) % BLOCK),
        BLOCK * (np.arange(16) // BLOCK),
    ]
).astype(np.float32)
LANE_X, LANE_Y, BLOCK_X, BLOCK_Y = 0, 16, 32, 48
