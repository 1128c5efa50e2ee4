"""Mistakes in a policy's inputs and outputs, made on purpose, are named from synthetic inputs."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations
from typing import Any

import numpy as np
import pytest

from eval.effects.interface import GRAVITY
from eval.judging.policy_checks.faults import notes_of, probable_faults, unused_inputs
from eval.judging.policy_checks.responses import responses
from eval.judging.policy_checks.rows import check_rows
from policies.block_policy import BlockPolicy
from policies.policy import checked_act, load_policy
from policies.spec import ActionSpec, PolicySpec
from tests.support.marks import more
from tests.support.pilots import Pursuit, Steady
from tracks.geometry.camera import Camera

FRD = np.array([1, -1, -1], np.float32)


def test_a_wrong_unit_or_frame_of_the_action_is_named():
    policy = load_policy("race-small")
    assert isinstance(policy, BlockPolicy) and probable_faults(policy) == ()
    changes = {
        "action_gravity": lambda a: a + np.array([0, 0, 9.81], np.float32),
        "action_frame": lambda a: a * np.array([1, -1, -1], np.float32),
        "action_order": lambda a: a[:, [2, 0, 1]],
        "action_zero": lambda a: 0 * a,
        "action_scale": lambda a: a / 20,
        "action_limited": lambda a: a * 20,
        "action_not_finite": lambda a: a * np.float32("nan"),
        "image_scale": lambda a: a,
    }
    for fault, change in changes.items():

        def model(state, image, hidden, change=change, divide=fault == "image_scale"):
            if divide:
                most = image.max((1, 2), keepdims=True)
                image = image / np.where(most == 0.0, 1.0, most)  # zeros fill up a block
            action, hidden = policy.model(state, image, hidden)
            return change(action), hidden

        (doubt,) = notes_of(replace(policy, model=model))
        assert doubt.fault == fault
        ambiguous = fault in ("action_gravity", "action_frame", "action_order")
        assert ("or its state or image has other units" in doubt.fix) == ambiguous


shipped = cache(load_policy)


@pytest.mark.parametrize(
    "order", [more(one) if one[0] == 2 else one for one in permutations(range(3))]
)
def test_any_order_of_the_actions_axes_is_named_and_shipped_policies_have_none(order):
    expected = [] if order == (0, 1, 2) else ["action_order"]
    for name in ("race", "race-small", "race-paper"):
        policy = shipped(name)

        def model(state, image, hidden, model=policy.model):
            action, hidden = model(state, image, hidden)
            return action[:, list(order)], hidden

        found = probable_faults(replace(policy, model=model))
        assert [doubt.fault for doubt in found] == expected
        assert not found or f"order {', '.join('xyz'[k] for k in order)}" in found[0].evidence


def test_a_thrust_that_is_a_share_and_a_camera_in_radians_are_doubted():
    def faults(action, **camera):
        spec = PolicySpec(action=ActionSpec("ctbr"), camera=Camera(**camera))
        return [doubt.fault for doubt in probable_faults(Steady(action, spec))]

    assert faults((0.4, 0.0, 0.0, 0.0)) == ["action_thrust"]
    assert faults((GRAVITY, 0.0, 0.0, 0.0)) == []
    assert faults((GRAVITY, 0.0, 0.0, 0.0), fov_deg=(1.37, 1.11)) == ["camera_fov"]


VELOCITY, GATES, LAST_ACTION = [0, 1, 2], [6, 7, 8, 12, 13, 14], [9, 10, 11]


def changed(policy, part=(), state=None, image=None):
    """Return the policy with a function that changes a part of its state, or its images."""

    def model(states, images, hidden):
        if state is not None:
            states = states.copy()
            states[:, part] = state(states[:, part])
        return policy.model(states, images if image is None else image(images), hidden)

    return replace(policy, model=model)


@pytest.mark.parametrize(
    ("fault", "text", "change"),
    [
        ("velocity_sign", "velocity in y,", {"part": [1], "state": np.negative}),
        ("velocity_sign", "in y and z,", {"part": VELOCITY, "state": lambda v: v * FRD}),
        ("velocity_scale", "hardly decelerates", {"part": VELOCITY, "state": lambda v: v / 10}),
        ("velocity_scale", "hardly decelerates", {"part": GATES, "state": lambda v: v * 10}),
        ("image_flipped", "(left or right)", {"image": lambda i: i[:, :, ::-1]}),
        ("image_flipped", "(up or down)", {"image": lambda i: i[:, ::-1]}),
        ("input_units", "even towards a gate below", {"image": lambda i: 9.1 - i}),
        ("input_units", "even towards a gate below", {"part": VELOCITY, "state": lambda v: v * 10}),
    ],
)
def test_a_wrong_sign_or_unit_of_an_input_is_named(fault, text, change):
    (doubt,) = probable_faults(changed(shipped("race"), **change))
    assert doubt.fault == fault and text in doubt.evidence


@dataclass
class Turning(Pursuit):
    """Pursuit that commands thrust and body rates, of which `change` makes a mistake."""

    spec: PolicySpec = PolicySpec(action=ActionSpec("ctbr"))
    change: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    order: tuple[int, ...] = (0, 1, 2, 3)
    weight: float = GRAVITY

    def act(self, hidden, state, image, fresh):
        wanted = super().act(hidden, state, image, fresh)[0] + GRAVITY * state[:, 3:6]
        size = np.linalg.norm(wanted, axis=1)
        yaw = np.arctan2(state[:, 7], state[:, 6])
        rates = [-6 * wanted[:, 1] / size, 6 * wanted[:, 0] / size, 2 * yaw]
        thrust = wanted[:, 2] + (self.weight - GRAVITY) * state[:, 5]
        action = np.stack([thrust, *rates], -1)[:, self.order] * self.change
        return action.astype(np.float32), hidden


@pytest.mark.parametrize(
    ("fault", "text", "mistake"),
    [
        (None, "", {}),
        ("action_frame", "its pitch and yaw rate", {"change": (1, 1, -1, -1)}),
        ("action_frame", "its roll rate", {"change": (1, -1, 1, 1)}),
        ("action_frame", "its yaw rate", {"change": (1, 1, 1, -1)}),
        ("action_order", "with its pitch rate", {"order": (0, 2, 1, 3)}),
        ("action_thrust", "a thrust of", {"order": (1, 2, 3, 0)}),
        ("action_thrust", "a thrust of", {"change": (0.1, 1, 1, 1)}),
        ("action_thrust", "a thrust of", {"weight": 0.0}),
        ("action_rates", "rad/s in level flight", {"change": (1, 57.3, 57.3, 57.3)}),
    ],
)
def test_a_mistake_of_thrust_and_rates_is_named(fault, text, mistake):
    found = probable_faults(Turning(**mistake))
    assert [doubt.fault for doubt in found] == ([fault] if fault else [])
    assert not found or text in found[0].evidence


def test_inputs_without_effect_are_named():
    race = shipped("race")
    near_sighted = replace(race.spec, camera=replace(race.spec.camera, range_m=1.5))
    assert unused_inputs(race) == unused_inputs(replace(race, spec=near_sighted)) == []
    assert responses(replace(race, spec=near_sighted)).near.any()
    (note,) = unused_inputs(changed(race, LAST_ACTION, np.zeros_like, np.zeros_like))
    assert "does not depend on its image or last action" in note.evidence
    (note,) = unused_inputs(Pursuit())
    assert "image or last action or memory" in note.evidence


@dataclass
class Filtered(Pursuit):
    """Pursuit with a low-pass filter, whose memory is kept in one of several places."""

    kept: str = "hidden"
    last: np.ndarray | None = None

    def start(self, n):
        if self.kept == "cleared":
            self.last = None
        return np.zeros((n, 3), np.float32)

    def act(self, hidden, state, image, fresh):
        wanted = super().act(hidden, state, image, fresh)[0]
        before = hidden if self.kept in ("hidden", "leaking") else self.last
        if before is None or before.shape != wanted.shape:
            before = np.zeros_like(wanted)
        if self.kept == "hidden":
            before = np.where(fresh[:, None], np.float32(0), before)
        self.last = (before + wanted) / 2
        return self.last, self.last


@pytest.mark.parametrize(
    ("kept", "fault"),
    [
        ("hidden", None),
        ("leaking", "memory_not_reset"),
        ("cleared", "memory_not_reset"),
        ("object", "memory_outside"),
    ],
)
def test_a_memory_that_outlives_a_trial_is_named(kept, fault):
    assert [note.fault for note in check_rows(Filtered(kept=kept))] == ([fault] if fault else [])


class InPlace(Pursuit):
    """Pursuit that scales its inputs, and gives its answers, each time in the same array."""

    answer: Any = None

    def act(self, hidden, state, image, fresh):
        state *= np.float32(0.5)
        image -= image.mean()
        action, hidden = super().act(hidden, 2 * state, image, fresh)
        if self.answer is None:
            self.answer = action
        self.answer[:] = action
        return self.answer, hidden


def test_a_policy_may_write_into_its_inputs():
    expected, found = responses(Pursuit(gain=8.0)), responses(InPlace(gain=8.0))
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_array_equal(one, other)
    state, image = np.ones((1, 12), np.float32), np.ones((1, 24, 32), np.float32)
    checked_act(InPlace(), np.zeros((1, 3)), state, image, np.ones(1, bool))
    assert (state == 1.0).all() and (image == 1.0).all()


def test_a_tensor_with_a_gradient_is_refused_by_name():
    torch = pytest.importorskip("torch")
    policy = Steady()
    policy.act = lambda *inputs: (torch.zeros((1, 3), requires_grad=True), None)
    with pytest.raises(ValueError, match=r"'steady'.*torch.no_grad"):
        checked_act(policy, None, np.zeros((1, 12)), np.zeros((1, 24, 32)), np.ones(1, bool))


def test_a_policy_that_returns_tensors_is_tested_without_a_warning():
    import torch

    class Tensors(Pursuit):
        calls = 0

        def act(self, hidden, state, image, fresh):
            action, hidden = super().act(hidden, state, image, fresh)
            self.calls += 1
            return torch.as_tensor(action + self.calls), hidden

    (note,) = check_rows(Tensors(3.0))
    assert note.fault == "memory_outside"


def test_a_torch_network_in_training_is_refused_as_its_rows_depend_on_each_other():
    import torch

    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(12, 3), torch.nn.BatchNorm1d(3))

    class Normalised(Pursuit):
        def act(self, hidden, state, image, fresh):
            with torch.no_grad():
                return network(torch.as_tensor(state)).numpy(), hidden

    with pytest.raises(ValueError, match=r"other rows of its batch.*eval\(\)"):
        check_rows(Normalised())  # a single row is an error of the network
    network.eval()
    assert not check_rows(Normalised())


def test_a_block_policy_and_an_object_with_notes_of_its_own_are_tested_by_rows():
    @dataclass
    class Noted(Pursuit):
        notes: str = "version 3"

    class Mean(Noted):
        def act(self, hidden, state, image, fresh):
            action, hidden = super().act(hidden, state, image, fresh)
            return action - state.mean(0)[:3], hidden

    block = BlockPolicy("mean", PolicySpec(), lambda *x: (x[0][:, :3] - x[0].mean(), x[2]), (0,))
    assert not notes_of(Noted())
    for policy in (Mean(), block):
        with pytest.raises(ValueError, match="a row's action changes by .* other rows"):
            notes_of(policy)
