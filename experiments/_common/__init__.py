"""What the experiments share: results with conditions, simulated cycles, models, a descent."""
