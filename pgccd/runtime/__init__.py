"""What the pipeline needs of torch and CUDA: events, copies to the host, times of stages."""
