"""What all methods share: parameters, input and result, windows, Gauss-Newton steps, stop reasons, refusals."""
