import torch

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.keyframes import thinned
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe

CAMERA = Camera(10.0, 10.0, 3.5, 2.5, 8, 6)


def keyframe(index: int, x: float, turn: float = 0.0) -> Keyframe:
    image = torch.zeros(6, 8, 3)
    frame = Frame(index, float(index), image, image[..., 0], image[..., 0] == 0, CAMERA)
    return Keyframe(frame, se3.exp(torch.tensor([x, 0, 0, 0, turn, 0], dtype=torch.float64)))


def indices(keyframes) -> list[int]:
    return [k.frame.index for k in keyframes]


def test_the_most_redundant_goes_and_the_ends_stay():
    way = (keyframe(0, 0.0), keyframe(1, 0.1), keyframe(2, 0.11), keyframe(3, 0.3), keyframe(4, 0.301))
    assert indices(thinned(way, 4)) == [0, 1, 2, 4]
    assert indices(thinned(way, 3)) == [0, 2, 4]


def test_turning_counts_as_moving():
    turns = (keyframe(0, 0.0), keyframe(1, 0.0, 0.4), keyframe(2, 0.01, 0.41), keyframe(3, 0.0, 0.8))
    assert indices(thinned(turns, 3)) == [0, 2, 3]


def test_no_limit_and_too_few_keep_all():
    way = tuple(keyframe(i, 0.1 * i) for i in range(5))
    assert thinned(way, 0) == way
    assert thinned(way, 5) == way


def test_a_standing_camera_keeps_its_limit():
    kept: tuple[Keyframe, ...] = ()
    for i in range(50):
        kept = thinned((*kept, keyframe(i, 0.0)), 6)
    assert len(kept) == 6
    assert indices(kept)[0] == 0
    assert indices(kept)[-1] == 49
