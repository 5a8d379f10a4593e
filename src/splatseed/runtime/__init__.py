"""Where code runs: tasks and memory of processes, PyTorch's device, and compiled kernels."""
