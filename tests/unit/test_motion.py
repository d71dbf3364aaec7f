"""The constant-velocity guess."""

import torch
from analytic_room import pose

from tcgsplat.geometry import se3
from tcgsplat.tracking.motion import MAX_GAP, ConstantVelocity

TWIST = torch.tensor([0.3, -0.1, 0.2, 0.4, -0.5, 0.3], dtype=torch.float64)  # metres and radians per second


def at(seconds: float) -> torch.Tensor:
    """A camera that started somewhere and follows the twist."""
    return pose(1.0, 2.0, -0.5, degrees=(10, 20, 30)) @ se3.exp(TWIST * seconds)


def followed(*stamps: float) -> ConstantVelocity:
    motion = ConstantVelocity()
    for stamp in stamps:
        motion = motion.advanced(at(stamp), stamp)
    return motion


def same(a: torch.Tensor, b: torch.Tensor) -> None:
    torch.testing.assert_close(a, b, atol=1e-9, rtol=0)


def test_before_the_first_frame_the_guess_is_the_origin() -> None:
    same(ConstantVelocity().predict(12.3), se3.identity())


def test_after_one_frame_the_camera_is_guessed_to_stand_still() -> None:
    same(followed(5.0).predict(5.1), at(5.0))


def test_a_constant_twist_is_predicted_exactly_whatever_the_frame_times() -> None:
    same(followed(1.0, 1.03, 1.11).predict(1.30), at(1.30))


def test_an_old_velocity_is_not_followed_far() -> None:
    same(followed(1.0, 1.1).predict(9.0), at(1.1 + MAX_GAP))


def test_time_that_does_not_pass_moves_nothing() -> None:
    motion = followed(1.0, 1.1)
    same(motion.predict(1.1), at(1.1))
    same(motion.predict(0.5), at(1.1))
    again = motion.advanced(at(1.2), 1.1)
    same(again.T_map_cam, at(1.2))
    same(again.velocity, TWIST)


def test_a_lost_camera_slows_down() -> None:
    motion = followed(1.0, 1.1)
    coasted = motion.coasted(motion.predict(1.2), 1.2)
    same(coasted.T_map_cam, at(1.2))
    same(coasted.velocity, 0.5 * TWIST)
    again = coasted.coasted(coasted.predict(1.3), 1.3)
    same(again.T_map_cam, at(1.25))
    same(again.velocity, 0.25 * TWIST)


def test_the_jump_on_being_found_again_is_no_velocity() -> None:
    motion = followed(1.0, 1.1)
    coasted = motion.coasted(motion.predict(1.2), 1.2)
    found = coasted.advanced(pose(0.0, 0.0, 0.3) @ coasted.T_map_cam, 1.23)
    assert float(found.velocity.norm()) <= float(coasted.velocity.norm())
    onward = found.advanced(found.T_map_cam @ se3.exp(0.1 * TWIST), 1.33)
    same(onward.velocity, TWIST)


def test_velocity_survives_a_change_of_map() -> None:
    rebased = followed(1.0, 1.1).rebased()
    same(rebased.T_map_cam, se3.identity())
    same(rebased.predict(1.2), se3.exp(0.1 * TWIST))
