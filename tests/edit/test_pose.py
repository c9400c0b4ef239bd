"""Gaussians under an edit where a mask weakens the motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene, tinted_scene
from helpers.edit_sessions import TURN, part, same
from scgs_warp.edit import Edit, EditSession, Hold
from scgs_warp.edit.pose import NodePose, edited_gaussians
from scgs_warp.edit.rotations import from_axis, multiply, rotate, to_matrix
from scgs_warp.ops.harmonics_rotation import rotate_harmonics


def test_with_a_mask_holds_turn_colours_as_far_as_gaussians():
    scene = bar_scene(share=0.5)
    session = EditSession(scene)
    everything = tuple(range(len(session)))
    turn = from_axis([0, 1, 0], 135)
    rest = session.engine.motion_at(0.0).positions
    turns = np.tile(turn, (len(everything), 1))
    bent = NodePose(rotate(turn, rest), turns, turns)
    engine = session.engine
    posed = edited_gaussians(engine.rig, scene.gaussians, engine.motion_at(0.0), bent, engine.binding, True)
    before = torch.nn.functional.normalize(scene.gaussians.quats.detach().double(), dim=1)
    after = torch.nn.functional.normalize(posed.quats.double(), dim=1)
    own = multiply(after.numpy(), before.numpy() * [1, -1, -1, -1])
    np.testing.assert_allclose(np.degrees(2 * np.arccos(np.abs(own[:, 0]))), 67.5, atol=0.1)
    expected = rotate_harmonics(scene.gaussians.sh_rest, torch.from_numpy(own).float())
    torch.testing.assert_close(posed.sh_rest, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("share", [0.001, 0.5, 1.0])
def test_with_a_mask_handles_move_everything(share):
    scene = bar_scene(share=share, shaded=True)
    session = EditSession(scene)
    session.add_handle(range(len(session)), 0.6, "all")
    assert same(session.gaussians_at(0.6), scene.gaussians_at(0.6))
    session.move("all", [0.3, -0.2, 0.1], TURN)
    before, after = scene.gaussians_at(0.6), session.gaussians_at(0.6)
    R, pivot = torch.from_numpy(to_matrix(np.array(TURN))), torch.from_numpy(session.pivot("all"))
    expected = (before.means.double() - pivot) @ R.T + pivot + torch.tensor([0.3, -0.2, 0.1])
    torch.testing.assert_close(after.means.double(), expected, rtol=0, atol=1e-5)
    quats = torch.tensor(TURN).float().expand(len(before.means), 4).contiguous()
    torch.testing.assert_close(after.sh_rest, rotate_harmonics(before.sh_rest, quats), rtol=0, atol=1e-4)
    assert torch.equal(after.sh_dc, before.sh_dc) and torch.equal(after.scales, before.scales)


def test_with_a_mask_what_is_pinned_keeps_its_bits():
    scene = bar_scene(share=0.7)
    session = EditSession(scene)
    session.add_handle(part(session, 0.8, 1.0), 0.0, "right")
    session.pin(part(session, 0.0, 0.5))
    session.move("right", [0.0, 0.1, 0.0], TURN)
    before, after = scene.gaussians_at(0.4), session.gaussians_at(0.4)
    held = torch.isin(session.engine.binding[0].long(), torch.tensor(session.edit.pins)).all(1)
    assert 20 < int(held.sum()) < 380
    for name, value in before.tensors().items():
        assert torch.equal(value[held], getattr(after, name)[held]), name
    assert float((before.means - after.means).abs().max()) > 0.1


def test_with_a_mask_holds_keep_the_pose_of_their_time():
    scene = bar_scene(share=0.6)
    session = EditSession(scene)
    session.apply(Edit(holds=(Hold(tuple(range(len(session))), 0.2, "world"),)))
    before, after = scene.gaussians_at(0.2), session.gaussians_at(0.9)
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(after.quats.abs(), before.quats.abs(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("degrees", [45, 90, 170])
def test_correctives_are_carried_along_by_an_edit(degrees):
    """An edit that turns everything turns the displacements of the motion with it, however far it turns."""
    scene = bar_scene(shaded=True, corrected=True)
    plain = bar_scene(shaded=True)
    turn = from_axis([0, 1, 0], degrees)
    shifts = []
    for each in (scene, plain):
        session = EditSession(each)
        session.add_handle(range(len(session)), 0.8, "all")
        session.move("all", [0.3, -0.2, 0.1], turn.tolist())
        shifts.append((each.gaussians_at(0.8).means.detach().double(), session.gaussians_at(0.8).means.double()))
    (still, edited), (plain_still, plain_edited) = shifts
    R = torch.from_numpy(to_matrix(turn))
    assert float((still - plain_still).norm(dim=1).max()) > 5e-3
    torch.testing.assert_close(edited - plain_edited, (still - plain_still) @ R.T, rtol=0, atol=2e-5)


def test_a_bend_beyond_the_motion_moves_no_corrective_further():
    scene, plain = bar_scene(corrected=True), bar_scene()
    lengths = []
    for time in (0.3, 0.8):
        own = (scene.gaussians_at(time).means - plain.gaussians_at(time).means).norm(dim=1)
        bent = []
        for each in (scene, plain):
            session = EditSession(each)
            session.add_handle(part(session, 0.8, 1.0), time, "right")
            session.pin(part(session, 0.0, 0.5))
            session.move("right", [0.0, 0.0, 0.0], from_axis([0, 1, 0], 90).tolist())
            bent.append(session.gaussians_at(time).means)
        lengths.append((own, (bent[0] - bent[1]).norm(dim=1)))
    for own, under_edit in lengths:
        torch.testing.assert_close(under_edit, own, rtol=0, atol=2e-5)


def test_an_edit_keeps_the_tints_of_the_motion():
    scene = tinted_scene(shaded=True)
    session = EditSession(scene)
    session.add_handle(part(session, 0.8, 1.0), 1.0, "right")
    session.move("right", [0.0, 0.1, 0.0], TURN)
    before, after = scene.gaussians_at(1.0), session.gaussians_at(1.0)
    assert not torch.allclose(before.means, after.means, atol=1e-2)
    assert not torch.allclose(before.sh_dc, bar_scene(shaded=True).gaussians_at(1.0).sh_dc, atol=0.1)
    torch.testing.assert_close(after.sh_dc, before.sh_dc, rtol=1e-5, atol=1e-5)
