"""Kinds of contacts, the features that touch in each, and how a test ended."""

from typing import Final, Literal

#: Features, as columns of `MeshSet.offsets`.
VERTEX, FACE, EDGE = 0, 1, 2
#: What `features` counts, by kind, of i and of j. For INSIDE one is -1. Candidates have two such kinds: 5 for a vertex
#: of i inside of j, and 6 for a vertex of j inside of i; the other feature is 0.
FEATURES = (
    (VERTEX, FACE),
    (FACE, VERTEX),
    (EDGE, EDGE),
    (EDGE, FACE),
    (FACE, EDGE),
    (VERTEX, VERTEX),
    (VERTEX, VERTEX),
)

#: Whose normals contacts have: see `pgccd.detect`.
Normals = Literal["features", "surface"]
NORMALS = ("features", "surface")


class _NamedIntegers:
    # Not an IntEnum: torch.compile treats the comparison of a tensor with a member of an enumeration as constant.

    @classmethod
    def names(cls) -> dict[int, str]:
        """The name of each value.

        Example:
            >>> pgccd.Kind.names()[2]
            'EE'
        """
        return {value: name for name, value in vars(cls).items() if name.isupper()}


class Kind(_NamedIntegers):
    """Values of `kind`, plain integers: which features of a pair (i, j) touch. `features` lists the feature of i first.

    Attributes:
        VF_AB: vertex of i, face of j.
        VF_BA: face of i, vertex of j.
        EE: edge of i, edge of j.
        EF_AB: edge of i that passes through a face of j at t = 0.
        EF_BA: face of i, edge of j that passes through it at t = 0.
        INSIDE: a connected piece of one body that is inside of the other, a solid, at t = 0. `features` has a vertex of
            the piece for its body, and -1 for the solid.

    A body with itself, i = j, has the kinds VF_AB, EE with the smaller edge first, and EF_AB.

    Example:
        >>> edges = hits[hits.kind == pgccd.Kind.EE]
    """

    VF_AB: Final = 0
    VF_BA: Final = 1
    EE: Final = 2
    EF_AB: Final = 3
    EF_BA: Final = 4
    INSIDE: Final = 5


class Status(_NamedIntegers):
    """Values of `status`, plain integers: how a test ended.

    Attributes:
        FREE: certainly no contact.
        TOUCH: the features come within min_separation + tolerance.
        UNRESOLVED: the iteration budget was spent; counts as a contact.

    Example:
        >>> hits[hits.status == pgccd.Status.UNRESOLVED]
        Contacts(count=0, pcs=1, device=cpu)
    """

    FREE: Final = 0
    TOUCH: Final = 1
    UNRESOLVED: Final = 2
