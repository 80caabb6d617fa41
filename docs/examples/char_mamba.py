"""Small Mamba language model of characters, trained on Python's own help texts.

Run ``python docs/examples/char_mamba.py``. The text is ``pydoc_data.topics`` of Python (the output
of ``help("if")``). With mamba-ssm installed, and a CUDA device, the same program runs on mamba-ssm
after a change of the two lines that import from ``gamba_warp.compat``.
"""

from __future__ import annotations

import argparse
import time
from pydoc_data.topics import topics

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gamba_warp.compat.mamba_ssm import Mamba
from gamba_warp.compat.mamba_ssm.utils.generation import InferenceParams


class CharModel(nn.Module):
    """Embedding, Mamba layers with pre-norm and residuals, and a head over the alphabet."""

    def __init__(self, letters: int, width: int = 96, depth: int = 2) -> None:
        super().__init__()
        self.embedding = nn.Embedding(letters, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(depth + 1))
        self.layers = nn.ModuleList(Mamba(width, layer_idx=i) for i in range(depth))
        self.head = nn.Linear(width, letters)

    def forward(self, letters: Tensor, inference_params: InferenceParams | None = None) -> Tensor:
        """Map letters ``[B, L]`` to the next ones' logits ``[B, L, alphabet]``."""
        hidden = self.embedding(letters)
        for norm, layer in zip(self.norms, self.layers):
            hidden = hidden + layer(norm(hidden), inference_params=inference_params)
        return self.head(self.norms[-1](hidden))


def read_text() -> tuple[Tensor, str]:
    """The help texts as numbers ``[letters]``, and the alphabet that they index."""
    text = "\n".join(topics[name] for name in sorted(topics))
    alphabet = "".join(sorted(set(text)))
    number = {letter: i for i, letter in enumerate(alphabet)}
    return torch.tensor([number[letter] for letter in text]), alphabet


def train(model: CharModel, text: Tensor, steps: int, batch: int = 16, length: int = 128) -> float:
    """Train on random pieces of the text; print the loss, and return the last average."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=4e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=max(steps, 2))
    average, start = 0.0, time.perf_counter()
    for step in range(steps):
        first = torch.randint(len(text) - length, (batch, 1))
        piece = text[first + torch.arange(length + 1)]
        logits = model(piece[:, :-1])
        loss = F.cross_entropy(logits.flatten(0, 1), piece[:, 1:].flatten())
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        average = loss.item() if step == 0 else 0.9 * average + 0.1 * loss.item()
        if step % 50 == 0 or step == steps - 1:
            seconds = time.perf_counter() - start
            print(f"step {step:4d}  loss {average:.3f} nats a letter  {seconds:5.1f} s", flush=True)
    return average


@torch.no_grad()
def write(model: CharModel, prompt: Tensor, letters: int, temperature: float = 0.7) -> Tensor:
    """Continue a prompt ``[L]``: all of it at once, then letter by letter from the states."""
    model.eval()
    cache = InferenceParams(max_seqlen=len(prompt) + letters, max_batch_size=1)
    given, written = prompt[None], [prompt]
    for _ in range(letters):
        logits = model(given, cache)[0, -1]
        cache.seqlen_offset += given.shape[1]
        given = torch.multinomial(F.softmax(logits / temperature, -1), 1)[None]
        written.append(given[0])
    return torch.cat(written)


def main(arguments: list[str] | None = None) -> float:
    """Train, print a generated text, and return the last loss."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--letters", type=int, default=400, help="how many to write")
    parser.add_argument("--length", type=int, default=128, help="letters of a piece of text")
    options = parser.parse_args(arguments)
    torch.manual_seed(0)
    text, alphabet = read_text()
    model = CharModel(len(alphabet))
    parameters = sum(p.numel() for p in model.parameters())
    print(f"{len(text)} letters, an alphabet of {len(alphabet)}, {parameters} parameters")
    loss = train(model, text, options.steps, length=options.length)
    prompt = torch.tensor([alphabet.index(letter) for letter in "The statement "])
    start = time.perf_counter()
    written = write(model, prompt, options.letters)
    rate = options.letters / (time.perf_counter() - start)
    print(f"{rate:.0f} letters/s:\n" + "".join(alphabet[i] for i in written))
    return loss


if __name__ == "__main__":
    main()
