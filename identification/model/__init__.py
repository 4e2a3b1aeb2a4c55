"""The robot: kinematics, regressor, friction, payload, base parameters."""
