"""Named protocols of views: their values, and the changes in a report."""

from pathlib import Path

from gamba_warp.eval.views.options import ViewsOptions


def options(**given):
    return ViewsOptions(checkpoint=Path("a"), data=Path("b"), **given).filled()


def test_a_protocol_fills_in_what_is_not_given_and_names_what_is():
    """Also where the given is the default without a protocol."""
    default, splatter = options(), options(protocol="splatter-image")
    assert (default.reference, default.size, default.changed()) == (0, None, [])
    assert (splatter.reference, splatter.size, splatter.changed()) == (64, 128, [])
    changed = options(protocol="splatter-image", reference=0, size=64)
    assert (changed.reference, changed.size) == (0, 64)
    assert changed.changed() == ["size", "reference"]
