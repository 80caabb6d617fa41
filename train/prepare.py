"""What a run needs before its first step: the objects to train and to validate on, and LPIPS."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from gamba_warp.dataset import ViewDataset, open_dataset
from gamba_warp.errors import UserError
from gamba_warp.lpips import LPIPS, load_lpips, lpips_available

from .config import TrainConfig

# For one object the network's pass is shared by all views, and drawing them is cheap beside it.
_OVERFIT_VIEWS = 9


@dataclass(frozen=True)
class TrainingData:
    """What to train and to validate on.

    Attributes:
        train: objects to train on.
        objects: indices into ``train``; one pass over the list is an epoch.
        reference: the input view, or None for any.
        batch_size: objects per batch and process.
        novel: novel views of each at every step; None means as many as the schedule says.
        validation: objects to validate on.
        held_out: indices into ``validation``; may be empty.
        val_views: novel views of each; None means all.
        notes: lines for the user.
    """

    train: ViewDataset
    objects: list[int]
    reference: int | None
    batch_size: int
    novel: int | None
    validation: ViewDataset
    held_out: list[int]
    val_views: int | None
    notes: list[str]

    @property
    def fingerprint(self) -> str:
        """Of the names of the objects in their order: another list would be another run."""
        names = "\n".join(self.train.uids[i] for i in self.objects)
        return hashlib.sha256(names.encode()).hexdigest()[:16]


def open_data(config: TrainConfig) -> TrainingData:
    """Opens the dataset as the options say.

    Raises:
        UserError: no such folder, no objects, no such object, or none of them can be read.
    """
    if config.views.overfit is not None:
        return _open_one(config)
    views, run, notes = config.views, config.run, []
    train = open_dataset(config.data, "train", cache=views.cache)
    bad = train.check()
    objects = [i for i, uid in enumerate(train.uids) if uid not in bad]
    notes += [f"{uid} is left out: {reason}" for uid, reason in bad.items()]
    if not objects:
        raise UserError(f"{config.data}: none of its {len(bad)} objects can be read: {notes[0]}")
    validation, held_out = train, []
    try:
        validation = open_dataset(config.data, "val")
        bad = validation.check()
        good = [i for i, uid in enumerate(validation.uids) if uid not in bad]
        share = min(run.val_objects, len(good))
        held_out = [good[k * len(good) // share] for k in range(share)]
    except UserError as error:
        notes.append(f"no validation: {error}")
    return TrainingData(
        train=train,
        objects=objects,
        reference=0 if views.reference == "first" else None,
        batch_size=views.batch_size or 8,
        novel=views.views_per_object,
        validation=validation,
        held_out=held_out,
        val_views=run.val_views,
        notes=notes,
    )


def _open_one(config: TrainConfig) -> TrainingData:
    views = config.views
    dataset = open_dataset(config.data, "all", cache=True)
    name = views.overfit
    if name in dataset.uids:
        index = dataset.uids.index(name)
    elif name.isdigit() and int(name) < len(dataset):
        index = int(name)
    else:
        raise UserError(f"--overfit {name}: no such uid, nor a number under {len(dataset)}")
    return TrainingData(
        train=dataset,
        objects=[index] * dataset.num_views(index),
        reference=None if views.reference == "random" else 0,
        batch_size=views.batch_size or 1,
        novel=_OVERFIT_VIEWS if views.views_per_object is None else views.views_per_object,
        validation=dataset,
        held_out=[index],
        val_views=None,
        notes=[],
    )


def open_lpips(config: TrainConfig) -> tuple[LPIPS | None, str | None]:
    """LPIPS as ``--lpips`` says, and a line for the user where it is missing.

    Raises:
        UserError: "on", and its weights are not there.
    """
    loss = config.loss
    if loss.lpips == "off" or loss.lpips_weight == 0:
        return None, None
    if loss.lpips == "auto" and not lpips_available():
        return None, "no LPIPS weights: training without (gamba weights lpips fetches them)"
    return load_lpips(), None
