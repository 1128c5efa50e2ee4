"""What flights say of the model: rollouts of a second, force and torque."""
