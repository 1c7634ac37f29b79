"""What the experiments share: results with their conditions, simulated cycles, models, a descent."""
