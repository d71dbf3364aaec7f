"""What a frame tells of itself."""

from dataclasses import replace

import pytest
import torch
from analytic_room import Room


def test_what_was_measured_is_a_share_of_what_is_valid() -> None:
    frame = Room().frame()
    rows = torch.arange(frame.camera.height)[:, None].expand_as(frame.depth)
    seen = replace(frame, valid=rows >= 20, depth=torch.where(rows < 30, 0.0, frame.depth))  # of 60 rows
    assert frame.measured == 1
    assert seen.measured == pytest.approx(30 / 40)
    assert replace(frame, valid=torch.zeros_like(frame.valid)).measured == 0
