"""Training rejects Google Scanned Objects, which are for evaluation."""

from helpers import micro
from helpers.refusals import refused


def test_their_names_are_refused_wherever_they_come_from(tmp_path):
    """A dataset of which one scanned object is for training and one for validation."""
    first, things = (micro.write_dataset(tmp_path / name, 3) for name in ("first", "things"))
    for old, new in (("clouda", "Dino_4"), ("cloudc", "Elephant")):
        (things / old).rename(things / new)
    micro.write_split(things, train=["Dino_4", "cloudb"], val=["Elephant"])
    out = tmp_path / "run"
    for data, views, names in (
        (things, {}, "Dino_4, Elephant"),
        (first, {"extra": (things,)}, "things/Dino_4"),
    ):
        line = f"the data has Google Scanned Objects.*\\({names}\\): leave them out"
        refused(line, micro.run, data, out, views=views)
    assert not out.exists()
