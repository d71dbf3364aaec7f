"""Pictures of keyframes that wait in the CPU's memory while the map is on a device, the pretended one."""

import logging

import pytest
import torch
from analytic_room import CAMERA, Room, walk

if torch.cuda.is_available():
    pytest.skip("torch has room for one device beside the CPU, and a GPU is here", allow_module_level=True)

from elsewhere import DEVICE, Distant

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping import memory
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Keyframe, Submap


def test_older_pictures_wait_and_the_map_is_the_same(
    rasterizer: Rasterizer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def mapped(gb: float) -> Submap:
        config = MapperConfig(
            seeding=SeedingConfig(spacing=2), first_iterations=2, iterations=4, max_keyframes=0, max_gpu_memory=gb
        )
        mapper = Mapper(config, ConfidenceConfig(), Distant(rasterizer), IdSource(), torch.Generator().manual_seed(0))
        submap = Submap.anchored(se3.identity(), 0, device=DEVICE)
        for index, T in enumerate(walk(5)):
            submap = mapper.optimized(mapper.grown(Keyframe(Room().frame(T, index), T), submap)).submap
        return submap

    monkeypatch.setattr(memory, "OVERHEAD", 0)
    own = len(mapped(0.0)) * memory._working_bytes(0) + memory.WORKING_BYTES_PER_PIXEL * CAMERA.width * CAMERA.height
    assert not caplog.messages
    pictures = 2 * memory.IMAGE_BYTES * CAMERA.width * CAMERA.height
    with caplog.at_level(logging.WARNING):
        free, tight = mapped(0.0), mapped((own + 2.5 * pictures) / memory.BYTES_PER_GB)
    assert [keyframe.frame.color.device == DEVICE for keyframe in free.keyframes] == [True] * 5
    assert [keyframe.frame.color.device == DEVICE for keyframe in tight.keyframes] == [False] * 3 + [True] * 2
    assert torch.equal(free.gaussians.means.cpu(), tight.gaussians.means.cpu())
    (told,) = caplog.messages
    assert told.endswith(" GB: pictures of keyframes do not all fit: the 2 newest stay, others are fetched")
