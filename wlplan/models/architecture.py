"""Names of the parts that the networks are built of. Without JAX, for the command line."""

ACTIVATIONS = ("swish", "leaky_relu")
"""Activation functions of the paper's grid search."""

ENCODERS = ("convolutional", "principal")
"""What tells ψ_high about the map: the paper's encoder, and ours."""
