"""Numbers of points, packed so that a point is one load or one store, in the lanes of vector registers and back.

The points of a block of rows of cells (see ``row_blocks.py``) have two numbers each in 2D and four, the last one spare,
in 3D. To and from vectors of one component of many points they get by transposing squares of registers, as nobody's
compiler does by itself: it would read and write number by number. The snippets are for compilers of LLVM's family, for
processors of any kind.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpfem.dtypes import types

LANES = 16
"""Points that are turned at a time: wider registers there are none, for narrower ones the compiler takes several."""


def packed_size(dim: int) -> int:
    """Numbers of a packed point."""
    return 2 * dim - 2


def _shuffle(a: str, b: str, picks: list[int]) -> str:
    return f"__builtin_shufflevector({a}, {b}, {', '.join(map(str, picks))})"


def _range(first: int, count: int) -> list[int]:
    return list(range(first, first + count))


def _joined(parts: list[str], size: int) -> str:
    """The vector of all numbers of some vectors, of ``size`` numbers each."""
    while len(parts) > 1:
        size *= 2
        parts = [_shuffle(a, b, _range(0, size)) for a, b in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def _transposed(size: int) -> list[str]:
    """The rows of the transposes of the squares of ``size`` numbers of the vectors z[0], z[1], ... side by side."""

    def picked(a: str, b: str, of_square: list[int]) -> str:
        """Of each square some entries of ``a``, from 0 on, and of ``b``, from ``size`` on."""
        picks = [s + k if k < size else LANES + s + k - size for s in range(0, LANES, size) for k in of_square]
        return _shuffle(a, b, picks)

    if size == 2:
        return [picked("z[0]", "z[1]", [i, 2 + i]) for i in range(2)]
    pairs = [picked(f"z[{a}]", f"z[{a + 1}]", [h, 4 + h, h + 1, 5 + h]) for h in (0, 2) for a in (0, 2)]
    return [picked(pairs[h], pairs[h + 1], [i, i + 1, 4 + i, 5 + i]) for h in (0, 2) for i in (0, 2)]


@functools.cache
def packed_point_functions(dim: int, dtype: str, width: int) -> SimpleNamespace:
    """The functions ``pack``, ``load_rows``, ``add_rows`` and ``unpack`` for ``LANES`` rows of ``width`` points.

    Places of these points among a block's packed ones are listed as (width, LANES), the components of what they have as
    (width, dim, LANES).
    """
    t = types(dim, dtype)
    scalar, vector = t.scalar, t.vector
    number = {"float32": "float", "float64": "double"}[dtype]
    size = packed_size(dim)
    vectors = "".join(
        f"typedef {number} V{n} __attribute__((ext_vector_type({n}), aligned(sizeof({number}))));\n"
        for n in (2, 4, 8, LANES)
    )
    components = range(dim)
    turned = _transposed(size)
    of_squares = [[f"points[own[{k}]]" for k in range(q, LANES, size)] for q in range(size)]
    parts = [_shuffle(f"w[{k % size}]", f"w[{k % size}]", _range(k - k % size, size)) for k in range(LANES)]
    loaded = f"V{LANES} z[] = {{ {', '.join(_joined(own, size) for own in of_squares)} }};" + "".join(
        f"*list[{i}] = {turned[i]};\n" for i in components
    )
    added = f"V{LANES} z[{size}] = {{ {', '.join(f'*list[{i}]' for i in components)} }};" + (
        f"V{LANES} w[] = {{ {', '.join(turned)} }};"
        + "".join(f"points[own[{k}]] += {parts[k]};\n" for k in range(LANES))
    )
    lists = ", ".join(f"(V{LANES}*)(listed.data + (a * {dim} + {i}) * {LANES})" for i in components)
    points = f"{vectors} V{size}* points = (V{size}*)packed.data;"
    each = f"""
        for (int a = 0; a < {width}; ++a) {{
            const wp::uint16* own = row_points.data + first + a * {LANES};
            V{LANES}* list[] = {{ {lists} }};
            %s
        }}"""
    pack = f"""
        for (int k = begin; k < end; ++k) {{
            const {number}* value = (const {number}*)values.data + {dim} * block_points.data[k];
            points[k - begin] = V{size}{{ {", ".join(f"value[{i}]" for i in components)} }};
        }}"""
    unpack = f"""
        for (int k = begin; k < end; ++k) {{
            V{size} point = points[k - begin];
            points[k - begin] = 0;
            wp::int32 target = targets.data[k];
            if (target < 0) {{
                {number}* put = ({number}*)aside.data + {dim} * (-1 - target);
                {"".join(f"put[{i}] = point[{i}];" for i in components)}
            }} else {{
                {number}* sum = ({number}*)sums.data + {dim} * target;
                {"".join(f"sum[{i}] += point[{i}];" for i in components)}
            }}
        }}"""

    @wp.func_native(points + pack)
    def pack_points(
        values: wp.array(dtype=vector),
        block_points: wp.array(dtype=wp.int32),
        begin: int,
        end: int,
        packed: wp.array(dtype=scalar),
    ):
        """Packs the values of the points begin..end of all blocks'."""

    @wp.func_native(points + each % loaded)
    def load_rows(
        packed: wp.array(dtype=scalar),
        row_points: wp.array(dtype=wp.uint16),
        first: int,
        listed: wp.array(dtype=scalar),
    ):
        """Lists the components of the points in places ``first`` and after."""

    @wp.func_native(points + each % added)
    def add_rows(
        listed: wp.array(dtype=scalar),
        row_points: wp.array(dtype=wp.uint16),
        first: int,
        packed: wp.array(dtype=scalar),
    ):
        """Adds the components listed to the points in places ``first`` and after."""

    @wp.func_native(points + unpack)
    def unpack_points(
        packed: wp.array(dtype=scalar),
        targets: wp.array(dtype=wp.int32),
        begin: int,
        end: int,
        sums: wp.array(dtype=vector),
        aside: wp.array(dtype=vector),
    ):
        """Adds what is packed to where the targets begin..end are, or for target -1 - k puts it aside in place k, and
        leaves 0."""

    return SimpleNamespace(pack=pack_points, load_rows=load_rows, add_rows=add_rows, unpack=unpack_points)
