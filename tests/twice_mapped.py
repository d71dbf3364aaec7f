"""A submap of two views of the analytic room, for what is done with one; and whether two are the same."""

from dataclasses import fields

import torch
from analytic_room import CAMERA, Room, pose

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.feedback import judged
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Keyframe, Submap


def twice_mapped(
    config: MapperConfig, confidence: ConfidenceConfig, rasterizer: Rasterizer, camera: Camera = CAMERA
) -> Submap:
    """The second view shows more than the first; judged, so that there is something for Eqs. 20 to 24 to do."""
    mapper = Mapper(config, confidence, rasterizer, IdSource(), torch.Generator().manual_seed(0))
    submap = Submap.anchored(se3.identity(), 0, config.sh_degree, rasterizer.device)
    for index, T in enumerate((pose(), pose(-0.1, 0.05, -0.3, degrees=(0, 14, 0)))):
        grown = mapper.grown(Keyframe(Room().frame(T, index, camera=camera), T), submap)
        submap = judged(mapper.optimized(grown), grown.frame, confidence, config.depth_mode, rasterizer)
    return submap


def assert_same(ours: Submap, expected: Submap) -> None:
    """Gaussians and their confidence, to the bit; ours wherever they are, the expected ones on the CPU."""
    ours = ours.cpu()
    for table, other in ((ours.gaussians, expected.gaussians), (ours.confidence, expected.confidence)):
        for field in fields(table):
            assert torch.equal(getattr(table, field.name), getattr(other, field.name)), field.name
