"""Products contracted with sums, as ptxas may where PTX does not name their rounding."""

import copy
import functools
from collections import Counter

from .machine import Instruction, opcodes
from .parse import Program

_KINDS = (".f32", ".ftz.f32")  # a module has one of them


@functools.cache
def contracted(program: Program) -> Program:
    """A copy in which each product that only one sum reads, in the same run of code, joins it."""
    made = copy.copy(program)
    code = made.code = type(program.code).from_buffer_copy(program.code)
    names = {number: name for name, (number, *_) in opcodes().items()}
    written = Counter(x for i in code for x in i.to[: i.writes])
    read = Counter(x for i in code for x in i.given[: i.reads])
    targets = {i.target for i in code if names[i.op] == "bra"}
    products: dict[int, Instruction] = {}  # by where their result lies, those of this run of code
    for at, i in enumerate(code):
        if at in targets or names[i.op] == "bra":
            products.clear()
        sides = [k for k in (0, 1) if i.given[k] in products]
        first, kind = names[i.op][:3], names[i.op][3:]
        if first in ("add", "sub") and kind in _KINDS and i.guard < 0 and sides:
            side = sides[0]
            name = ("fma.rn" if first == "add" else ("a * b - c", "c - a * b")[side]) + kind
            product, other = products.pop(i.given[side]), i.given[1 - side]
            i.op, i.reads = opcodes()[name][0], 3
            i.given[:3] = [*product.given[:2], other]
        for result in i.to[: i.writes]:  # what a product is made of is no longer there
            products = {k: x for k, x in products.items() if result not in x.given[:2]}
        if first == "mul" and kind in _KINDS and i.guard < 0:
            if written[i.to[0]] == read[i.to[0]] == 1:
                products[i.to[0]] = i
    return made
