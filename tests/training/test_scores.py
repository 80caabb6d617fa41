"""Validation from the start on, and an end that is worse."""

from helpers.micro import lines, run, same_weights


def test_a_fine_tuning_is_validated_before_it_begins(data, tmp_path, capsys):
    assert run(data, tmp_path / "first", run={"val_every": 3}) == 0
    assert [line["step"] for line in lines(tmp_path / "first", "val")] == [3, 6]
    tuned = {"init": tmp_path / "first", "val_every": 3}
    capsys.readouterr()
    spoiled = {"optim": {"lr": 3.0, "ema": 0.0}}
    assert run(data, tmp_path / "second", run=tuned, **spoiled) == 0
    vals = lines(tmp_path / "second", "val")
    assert [line["step"] for line in vals] == [0, 3, 6]
    ends = lines(tmp_path / "first", "val")[-1]
    assert vals[0]["psnr_novel"] == ends["psnr_novel"]
    *_, warning = (line["message"] for line in lines(tmp_path / "second", "warning"))
    assert "the last validation is worse than the first: PSNR" in warning
    assert "dB at step 0; best.safetensors has" in warning and warning in capsys.readouterr().out
    assert same_weights(
        tmp_path / "second" / "best.safetensors", tmp_path / "first" / "model.safetensors"
    )


def test_a_validation_at_the_start_changes_no_bit(data, tmp_path):
    assert run(data, tmp_path / "first") == 0
    for name, every in (("with", 100), ("without", 0)):
        out = tmp_path / name
        assert run(data, out, run={"init": tmp_path / "first", "val_every": every}) == 0
    assert same_weights(tmp_path / "with/model.safetensors", tmp_path / "without/model.safetensors")
