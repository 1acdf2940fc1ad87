"""SE(3), projection, Gaussians, robust statistics: pure functions on tensors."""
