"""The example of docs/examples learns, and writes what its whole text would give."""

import pytest
import torch
from examples import char_mamba


def test_it_learns_and_writes(capsys):
    loss = char_mamba.main(["--steps", "25", "--letters", "9", "--length", "32"])
    out = capsys.readouterr().out
    first = float(out.split("loss ")[1].split()[0])
    assert loss < first - 0.3, "the average of the loss falls"
    assert out.rpartition("letters/s:\n")[2].startswith("The statement ")


def test_it_writes_the_letters_that_the_whole_text_gives():
    model, prompt = char_mamba.CharModel(11, width=16), torch.tensor([3, 1, 4, 1, 5])
    with torch.no_grad():
        model.head.weight *= 1e4  # so that each letter is certain
        model.head.bias *= 0
        written = char_mamba.write(model, prompt, 12)
        logits = model(written[None])[0]
    assert torch.equal(written[:5], prompt)
    assert torch.equal(logits[4:-1].argmax(-1), written[5:])


def test_layers_of_one_kind_have_one_result(capsys):
    """docs/examples/layer_speed.py, small: mambapy's layer and the formula against ours."""
    pytest.importorskip("mambapy")
    from examples import layer_speed

    layer_speed.compare(width=16, length=9, turns=1)
    for line in capsys.readouterr().out.splitlines()[1:]:
        errors = [float(word) for word in line.partition("to the loop ")[2].split(" and ")]
        assert len(errors) == 2 and max(errors) < 2e-6, line
