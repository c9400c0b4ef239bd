"""Each op runs the form of its device, and refuses a form that it does not have."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.ops.correctives import correct
from scgs_warp.ops.forms import Form, GpuForm, chosen_form
from scgs_warp.ops.projection import project
from scgs_warp.ops.shading import shade, tint

CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)


@pytest.mark.parametrize(
    ("forms", "device", "expected"), [(Form, CPU, "cpu"), (Form, CUDA, "plain"), (GpuForm, CUDA, "cuda")]
)
def test_auto_is_the_form_of_the_device_or_plain(forms, device, expected):
    assert chosen_form("auto", device, forms) == expected
    assert chosen_form("plain", device, forms) == "plain"


def test_the_form_of_a_cpu_needs_tensors_there():
    assert chosen_form("cpu", CPU) == "cpu"
    with pytest.raises(ValueError, match="form cpu needs tensors on the CPU, got cuda:0"):
        chosen_form("cpu", CUDA)


N3, N4, EYE = torch.ones(2, 3), torch.ones(2, 4), torch.eye(4)
CALLS = {
    "correct": lambda form: correct(N3, torch.zeros(2, 27), N4, N4, form=form),
    "shade": lambda form: shade(N3, torch.zeros(2, 10), N4, N4, form=form),
    "tint": lambda form: tint(N3, N3, form=form),
    "project": lambda form: project(N3, N4, N3, torch.ones(2), EYE, EYE[:3, :3], 8, 8, form=form),
}


@pytest.mark.parametrize("name", sorted(CALLS))
def test_an_op_refuses_a_form_that_it_does_not_have(name):
    CALLS[name]("plain")
    with pytest.raises(ValueError, match="form must be auto, plain or cpu, got 'cuda'"):
        CALLS[name]("cuda")
