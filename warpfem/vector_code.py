"""What the compiler is told so that it turns loops over cells into vector code."""

import platform

MAX_UNROLL = 12
"""Longest loops that Warp may write out: over points of a cell and components, but not over lanes."""


def compiler_flags(depth: int, *others: str, inlined: int = 9000) -> str:
    """Warp's own flags with fused multiply-adds, the widest registers, and a depth for straight-line vector code.

    Args:
        depth: of the expressions of which straight-line code is made vectors.
        others: options of LLVM, as ``name=value``.
        inlined: what functions may cost, in LLVM's count, to be inlined; loops with calls in them stay as they are.
    """
    widest = ["-mprefer-vector-width=512"] if platform.machine() in ("x86_64", "AMD64") else []
    options = [f"inline-threshold={inlined}", "inline-cold-callsite-threshold=3000", f"slp-recursion-max-depth={depth}"]
    return " ".join(
        ["-march=native", "-ffp-contract=fast", *widest, *(f"-mllvm=-{option}" for option in [*options, *others])]
    )
