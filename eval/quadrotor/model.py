"""Add the quadrotor to a MuJoCo model as a body with the true mass and inertia.

The suite's simulators leave the actuators at zero, because these could not apply effects such as
drag. The simulators compute the force and torque of rotors and effects by a `Plant`, and write them
into `qfrc_applied` of the free joint, as `[R force_b, torque_b]`. Forces of a free joint are in
world axes, torques in body axes, and the body's origin is its centre of mass. A user without the
`Plant` may control the four actuators, whose control is a rotor's thrust in newton.
"""

from __future__ import annotations

import mujoco
import numpy as np

from eval.quadrotor.plant import make_plant
from eval.vehicles.vehicle import Vehicle

BODY = "quadrotor"
"""Name of the body and of its free joint."""
CAMERA = "depth"
"""Name of the camera."""
COLLIDES = "quadrotor box"
"""Name of the only geom (MuJoCo's solid) of the quadrotor that collides."""
VISUAL_GROUP = 2
"""Group of the geoms that are only drawn; rays and contacts skip them."""


def rotor_name(index: int) -> str:
    """Return the name of the site and of the actuator of rotor `index`, counted from 0."""
    return f"rotor_{index + 1}"


def add_quadrotor(spec: mujoco.MjSpec, vehicle: Vehicle) -> None:
    """Add `vehicle` to the world body of `spec`, with its effects on mass, inertia and gravity.

    The body's origin is the true centre of mass. The model's gravity is set, since the effect
    `frame_tilt` changes it. `compile_quadrotor` compiles the result. The integrator of `spec` must
    stay Euler for parity with the quadrotor in JAX.

    Raises:
        ValueError: where the effects make the mass zero or negative.
    """
    constants = make_plant(vehicle, 1.0 / vehicle.controller.frequency).constants
    spec.option.gravity = constants.gravity_w
    body = spec.worldbody.add_body(name=BODY)
    body.add_freejoint(name=BODY)
    body.explicitinertial = True
    body.mass = float(constants.mass)
    body.inertia = _limited_inertia(constants.inertia)
    # Geometry refers to the nominal centre of mass, the body's frame to the true one.
    origin = -constants.com_offset_b
    body.add_geom(
        name=COLLIDES,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=vehicle.body.half_size,
        pos=origin,
        mass=0.0,
        rgba=[0.15, 0.15, 0.18, 1.0],
    )
    thrust = constants.thrust_coefficient
    # A dead motor has no torque either; 0 / 0 would make the whole model's state NaN.
    ratio = constants.torque_coefficient / np.where(thrust > 0.0, thrust, np.inf)
    for index, hub in enumerate(constants.rotor_position_b):
        spin = vehicle.rotors.spin[index]
        name = rotor_name(index)
        body.add_site(name=name, pos=hub, size=[0.005, 0.005, 0.005])
        _add_visuals(body, name, origin, hub, spin)
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            gear=[0.0, 0.0, 1.0, 0.0, 0.0, -spin * float(ratio[index])],
            ctrllimited=True,
            ctrlrange=[0.0, vehicle.rotors.thrust_max],
        )
    _add_camera(body, vehicle, origin)


def compile_quadrotor(spec: mujoco.MjSpec, vehicle: Vehicle, dt: float) -> mujoco.MjModel:
    """Return the model of `spec` with `vehicle` in it, for steps of `dt` [s].

    MuJoCo's compiler refuses moments of inertia that break the triangle inequality. A fitted
    `inertia_scale` of a flat quadrotor often breaks it by a few percent. MuJoCo's dynamics work
    with any values, so the true values are set in the compiled model.
    """
    spec.option.timestep = dt
    add_quadrotor(spec, vehicle)
    model = spec.compile()
    model.body(BODY).inertia[:] = make_plant(vehicle, dt).constants.inertia
    # MuJoCo derives further constants from the inertia, which its steps use.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _limited_inertia(inertia: np.ndarray) -> np.ndarray:
    """Return `inertia` (3,) with its largest moment cut to the sum of the other two."""
    sum_of_others = inertia.sum() - inertia
    return np.minimum(inertia, sum_of_others * (1.0 - 1e-9))


def _add_visuals(
    body: mujoco.MjsBody, name: str, origin: np.ndarray, hub: np.ndarray, spin: int
) -> None:
    """Add an arm and a disk for one rotor, which neither collide nor weigh anything."""
    visual = {"contype": 0, "conaffinity": 0, "group": VISUAL_GROUP, "mass": 0.0}
    body.add_geom(
        name=f"{name} arm",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*origin, *hub],
        size=[0.006, 0.0, 0.0],
        rgba=[0.15, 0.15, 0.18, 1.0],
        **visual,
    )
    # The colour shows the direction of spin.
    rgba = [0.9, 0.35, 0.1, 0.5] if spin > 0 else [0.2, 0.5, 0.9, 0.5]
    body.add_geom(
        name=f"{name} disk",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=hub + [0.0, 0.0, 0.012],
        size=[0.0635, 0.002, 0.0],
        rgba=rgba,
        **visual,
    )


def _add_camera(body: mujoco.MjsBody, vehicle: Vehicle, origin: np.ndarray) -> None:
    """Add the vehicle's depth camera at the nominal centre of mass."""
    pitch = np.deg2rad(vehicle.camera.pitch_deg)
    # MuJoCo's cameras look along their -z with y up.
    right = [0.0, -1.0, 0.0]
    up = [-np.sin(pitch), 0.0, np.cos(pitch)]
    back = [-np.cos(pitch), 0.0, -np.sin(pitch)]
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, up, back], axis=-1).ravel())
    body.add_camera(
        name=CAMERA,
        pos=origin,
        quat=quat,
        fovy=vehicle.camera.fov_deg[1],
        resolution=[vehicle.camera.width, vehicle.camera.height],
    )
