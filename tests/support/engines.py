"""A stand-in for RotorPy's module of multirotors, for tests where it is not installed."""

from types import SimpleNamespace

import torch


class Params:
    def __init__(self, told, count, device):
        self.told, self.count = told, count
        assert len(told) == count


class Falling:
    """Bodies that fall and turn as they are, and rotors that are at once what is asked."""

    def __init__(self, params, count, start, device, integrator):
        assert integrator == "rk4", "the other one's steps hang on all rows"
        self.params = params

    def step(self, state, asked, dt, rows):
        assert torch.get_default_dtype() is torch.float64
        fall = torch.tensor([0.0, 0.0, -9.81])
        return {
            "x": state["x"] + dt * state["v"] + 0.5 * dt**2 * fall,
            "v": state["v"] + dt * fall,
            "q": state["q"],
            "w": state["w"],
            "wind": state["wind"],
            "rotor_speeds": asked["cmd_motor_speeds"],
        }


STAND_IN = SimpleNamespace(BatchedMultirotorParams=Params, BatchedMultirotor=Falling)
