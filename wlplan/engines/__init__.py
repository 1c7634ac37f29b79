"""What plays a loading cycle: the simulator, and discrete elements."""
