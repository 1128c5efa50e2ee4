"""The randomisation of a recipe's dynamics, as vehicles for environments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.vehicles.vehicle import Vehicle, with_effects
from suite.train.config import QuadrotorConfig
from suite.train.overrides import phase_configs


@dataclass(frozen=True)
class DrawnVehicle:
    """A function that draws a vehicle, as training does for each world."""

    config: QuadrotorConfig
    """The vehicle and its randomisation."""

    def __call__(self, rng: np.random.Generator) -> Vehicle:
        """Return the vehicle with drawn values of its effects."""
        # Training through the point mass does not load the judge's physics.
        from suite.train.dynamics.quadrotor import draw_effects

        drawn = {
            name: type(values)(*(np.asarray(value, float)[0].tolist() for value in values))
            for name, values in draw_effects(self.config, 1, rng).items()
        }
        return with_effects(self.config.vehicle, drawn)


def race_settings(recipe: str, vehicle: str = "racer5") -> dict[str, Any]:
    """Return arguments of the environments in `eval.envs` for training like a recipe.

    They are the policy's observation (`spec`) and vehicles (`vehicle`) with the recipe's
    randomisation, or the default one if it trains through a point mass.

    Args:
        recipe: a name of `suite train`.
        vehicle: a file or a shipped name; the centre of the randomisation.

    Raises:
        ValueError: for an unknown recipe or vehicle.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from suite.train.recipes import named_recipe, with_quadrotor

    last = phase_configs(named_recipe(recipe))[-1]
    config = with_quadrotor(last, load_vehicle(vehicle))
    assert config.quadrotor is not None
    return {"spec": config.spec, "vehicle": DrawnVehicle(config.quadrotor)}
