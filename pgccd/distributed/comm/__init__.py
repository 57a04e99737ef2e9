"""Messages between ranks: one interface, `Comm`, over torch.distributed and MPI, and rows of columns."""
