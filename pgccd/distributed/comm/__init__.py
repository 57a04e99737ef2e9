"""Communication between ranks: one interface, `Comm`, over torch.distributed and MPI, and exchange of rows."""
