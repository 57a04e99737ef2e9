"""What torch.distributed.checkpoint is to write and read: rows of columns."""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed.checkpoint as dcp
from torch import Tensor
from torch.distributed.checkpoint.metadata import ChunkStorageMetadata, MetadataIndex, TensorProperties
from torch.distributed.checkpoint.planner import LoadPlan, ReadItem, SavePlan, TensorWriteData, WriteItem, WriteItemType
from torch.distributed.checkpoint.planner_helpers import create_read_items_for_chunk_list

__all__ = ["LoadRows", "SaveRows", "dcp"]


class SaveRows(dcp.DefaultSavePlanner):
    """Every rank's tensors are rows [begin, ...) of tensors with `total` rows."""

    def __init__(self, begin: int, total: int) -> None:
        super().__init__(flatten_state_dict=False, flatten_sharded_tensors=False)
        self._begin, self._total = begin, total

    def create_local_plan(self) -> SavePlan:
        items = []
        for name, column in self.state_dict.items():
            if len(column):
                chunk = _chunk(column, self._begin)
                size = torch.Size([self._total, *column.shape[1:]])
                data = TensorWriteData(chunk, TensorProperties.create_from_tensor(column), size)
                items.append(WriteItem(MetadataIndex(name, chunk.offsets), WriteItemType.SHARD, tensor_data=data))
        self.plan = SavePlan(items)
        return self.plan

    def lookup_object(self, index: MetadataIndex) -> Any:
        return self.state_dict[index.fqn]


class LoadRows(dcp.DefaultLoadPlanner):
    """Reads rows [begin, ...) of tensors, whichever rank wrote them."""

    def __init__(self, begin: int) -> None:
        super().__init__(flatten_state_dict=False, flatten_sharded_tensors=False)
        self._begin = begin

    def create_local_plan(self) -> LoadPlan:
        assert self.metadata is not None
        items: list[ReadItem] = []
        for name, column in self.state_dict.items():
            stored: Any = self.metadata.state_dict_metadata[name]
            if stored.properties.dtype != column.dtype or stored.size[1:] != column.shape[1:]:
                raise ValueError(f"{name} is {stored.properties.dtype} {tuple(stored.size)}")
            if len(column):
                items += create_read_items_for_chunk_list(name, stored, [_chunk(column, self._begin)])
        return LoadPlan(items)

    def lookup_tensor(self, index: MetadataIndex) -> Tensor:
        return self.state_dict[index.fqn]


def _chunk(column: Tensor, begin: int) -> ChunkStorageMetadata:
    return ChunkStorageMetadata(torch.Size([begin] + [0] * (column.dim() - 1)), column.shape)
