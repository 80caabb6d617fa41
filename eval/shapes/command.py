"""``gamba eval-geometry``: predicted shapes against true ones.

Slow imports are inside the command, so that ``--help`` is quick.
"""

from __future__ import annotations

import sys
from typing import Annotated

import tyro

from gamba_warp.batch import print_json, say
from gamba_warp.errors import UserError
from gamba_warp.untrusted.ranges import ranged

from .options import ShapesOptions


@ranged
def eval_geometry_command(
    options: Annotated[ShapesOptions, tyro.conf.arg(name="")],
    json: bool = False,
) -> int:
    """Chamfer distance, F-score, normal consistency and Volume IoU of shapes.

    Prints the means with 95 % intervals over objects. Options default to the protocol's values.
    Exit code 1 if an object failed (each is listed), 2 if nothing could start.

    Args:
        options: of the evaluation.
        json: Print report.json in place of the summary.
    """
    if options.explain:
        return _explain(options)
    if options.pred is None or options.gt is None:
        raise UserError("give PRED and GT: two files or two folders")
    from ..report import FAILED, count_line, json_of
    from .pairs import evaluate_shapes
    from .protocol import chosen_protocol
    from .table import text_of

    protocol = chosen_protocol(options)
    if options.sensitivity:
        from .sensitivity import evaluate_variants

        table, records = evaluate_variants(options, protocol)
        print(table, end="")
        failed = [record for record in records if record["status"] == FAILED]
        for record in failed:
            say(f"failed: {record['name']}: {record['reason']}", sys.stderr)
        return 1 if failed else 0
    report = evaluate_shapes(options, protocol)
    for text in report["warnings"]:
        say(f"warning: {text}", sys.stderr)
    if json:
        print_json(json_of(report))
    else:
        print(text_of(report, protocol), count_line(report, options.out), sep="")
    return 1 if report["failures"] else 0


def _explain(options: ShapesOptions) -> int:
    """Print the protocol that the options name, with its source."""
    from .. import presets
    from ..report import flat
    from .protocol import PRESETS, chosen_protocol

    preset = presets.PRESETS.get(options.protocol)
    if preset is not None and preset.views is not None:
        print(presets.explain(options.protocol, preset.views), "", sep="\n")
    if preset is None or options.protocol in PRESETS:
        protocol = chosen_protocol(options)
        print(presets.explain(protocol.name, flat(protocol.fields(), lists=True)))
        if protocol.changes():
            print(f"changed: {', '.join(protocol.changes())}")
    return 0
