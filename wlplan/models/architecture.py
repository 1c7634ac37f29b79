"""Names of the parts that the networks are built of. Without JAX, for the command line."""

ACTIVATIONS = ("swish", "leaky_relu")
"""Activation functions of the paper's grid search."""

ENCODERS = ("convolutional", "principal")
"""How ψ_high sees the map: by the paper's encoder, or by ours."""
