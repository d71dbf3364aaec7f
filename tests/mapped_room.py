"""Submaps of the patterned room, made of frames at exactly known poses."""

from collections.abc import Sequence

import torch
from analytic_room import Room
from patterned_room import PatternedRoom

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.feedback import judged
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Pose

CAMERA = Camera(fx=114.0, fy=114.5, cx=79.3, cy=60.2, width=160, height=120)


def mapped(
    T_world_cam: Sequence[Pose], rasterizer: Rasterizer, *, index: int = 0, room: Room | None = None, seed: int = 0
) -> Submap:
    """A submap of what cameras see that stand so; the first one is its origin, and each is a keyframe."""
    seeding = SeedingConfig(recipe="surface", spacing=1, footprint=0.5, flatness=0.2, opacity=0.9, push_back=0.0)
    config = MapperConfig(
        seeding=seeding, iterations=10, first_iterations=20, depth_mode="planar", min_opacity=0.1, complete=False
    )
    confidence, room = ConfidenceConfig(), room or PatternedRoom()
    mapper = Mapper(config, confidence, rasterizer, IdSource(), torch.Generator().manual_seed(seed))
    submap = Submap.anchored(T_world_cam[0], index)
    for number, T in enumerate(T_world_cam):
        frame = room.frame(T, 100 * index + number, CAMERA)
        grown = mapper.grown(Keyframe(frame, se3.inverse(T_world_cam[0]) @ T), submap)
        submap = judged(mapper.optimized(grown), frame, confidence, config.depth_mode, rasterizer)
    return submap
