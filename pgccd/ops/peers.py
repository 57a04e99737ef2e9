"""Small messages between the GPUs of one host; on GPUs only.

memory: (bytes,) uint8 of this rank, zero before the first message: per rank 256 bytes, then twice the bytes of the
largest message. addresses: (ranks,) int64, of the memory of each rank in this process. stop: address of an int64 in
pinned memory; once it is nonzero, this rank gives up messages that have not arrived, and then sends none.
"""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops.library import int64, operator


@operator
def peer_gather(values: Tensor, memory: Tensor, addresses: Tensor, stop: int, rank: int) -> Tensor:
    """values (k,) int64 -> (ranks, k): those of every rank; 1 instead of values given up because of `stop`."""
    return int64(values, addresses.shape[0], values.shape[0])


@operator
def peer_minimum(
    values: Tensor,
    sent_rows: Tensor,
    sent: Sequence[int],
    received_rows: Tensor,
    received: Sequence[int],
    found: Tensor | None,
    anywhere: Tensor | None,
    memory: Tensor,
    addresses: Tensor,
    stop: int,
    rank: int,
) -> None:
    """Sends the rows `sent_rows` of values (N,) float64 >= 0, the first `sent[0]` of them to rank 0, and so on; then
    lowers the rows `received_rows` to the values that arrive, `received[r]` from rank r. A row of -1 is padding.
    Sets `anywhere` (1,) int64 to 1 if `found` (1,) int64 is nonzero on any rank.
    """
    return None
