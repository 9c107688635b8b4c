"""Learning for inference: gradients, trained proposals, adapted kernels."""
