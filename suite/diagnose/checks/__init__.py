"""What stands next to the names: log consistency, actuators, conditions, a black box."""
