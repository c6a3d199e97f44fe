"""Control laws and kinematics: pure functions of state and input."""
