"""Code generation for the ``fused`` backend: scalar code of a traced step, its adjoint, and the loops around both."""
