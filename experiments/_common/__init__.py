"""What the experiments share: results with their conditions, cycles simulated again, and models."""
