"""What an evaluation of views needs for every object, opened as the options say."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from gamba_warp.batch import check_not_read
from gamba_warp.data import gso
from gamba_warp.data.dataset import ViewDataset, open_dataset
from gamba_warp.devices import pick_device
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.fitting.objects import choose_objects
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.gaussians import Gaussians
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.weights import FETCH, lpips_available

from ..report import failure
from .baselines import (
    Baseline,
    Retrieval,
    TrainingMeshes,
    background,
    billboard,
    input_copy,
)
from .ceiling import open_ceiling
from .command import ViewsOptions
from .compare import Shown, Truth, ViewsProtocol
from .pictures import MEANING as PICTURES
from .pictures import PicturePredictions, Pictures
from .predictions import Predictions, open_predictions

# errors that are the failure of one object and stop no other
ERRORS = (UserError, OSError, MemoryError, ValueError, RuntimeError, ArithmeticError)


@dataclass
class Job:
    """What is the same for every object.

    Attributes:
        predictions: what is under test.
        dataset: where the true views come from.
        uids: the objects.
        protocol: what the numbers mean.
        network: of LPIPS, or None.
        device: torch device.
        baselines: by name.
        left_out: reasons by name, of baselines that cannot be had.
        failures: ``{name, reason}`` of what failed beside objects.
        retrieval: the baseline of this name, if it is one of them.
        meshes: of the training objects, to be placed as the retrieval's shapes; or None.
    """

    predictions: Predictions
    dataset: ViewDataset
    uids: list[str]
    protocol: ViewsProtocol
    network: LPIPS | None
    device: str
    baselines: dict[str, Baseline] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    failures: list[dict[str, str]] = field(default_factory=list)
    retrieval: Retrieval | None = None
    meshes: TrainingMeshes | None = None

    def predict(self, truth: Truth) -> Gaussians | Pictures:
        """Returns the Gaussians or pictures under test. Raises UserError where there are none."""
        if isinstance(self.predictions, PicturePredictions):
            return self.predictions.pictures(self.dataset, truth)
        return self.predictions.gaussians(self.dataset, truth.uid, self.protocol.reference)

    def fail(self, name: str, error: Exception | str) -> None:
        """Notes a failure beside those of objects."""
        self.failures.append({"name": name, "reason": failure(name, error)["reason"]})

    def shown(self, truth: Truth) -> dict[str, Shown]:
        """Returns what each baseline shows; one that fails is noted and stops no other."""
        result = {}
        for name, baseline in self.baselines.items():
            try:
                pictures = baseline(truth)
            except ERRORS as error:
                self.fail(f"{truth.uid} ({name})", error)
                continue
            if pictures is not None:
                result[name] = pictures
        return result


def open_job(options: ViewsOptions) -> Job:
    """Opens everything that the options name, and makes the folder of the report.

    Raises:
        UserError: something is not there, cannot be read, or cannot be written.
    """
    device = str(pick_device(options.device))
    dataset = open_dataset(options.data, options.split)
    uids = choose_objects(dataset.uids, (), options.limit)
    evaluation = gso.protocol_of(uids) if options.protocol == "gso" else None
    if evaluation is not None:
        uids = [uid for uid in uids if uid in gso.NAMES]
        if not uids:
            raise UserError(f"{options.data}: holds none of the objects of --protocol gso")
    _check_outputs(options, uids)
    predictions = open_predictions(
        options.checkpoint,
        options.distance,
        device,
        options.encoder_weights,
        resize=options.resize_pictures,
        margin=options.background_margin,
        precision=options.precision,
    )
    rendered: dict[str, Any] = {}
    if isinstance(predictions, PicturePredictions):
        if options.save_gaussians:
            raise UserError(f"--save-gaussians: {options.checkpoint} holds pictures")
        predictions.check(uids)
        rendered = {"rendering": "pictures of 8 bits", "pictures": PICTURES}
    elif options.resize_pictures:
        raise UserError(f"--resize-pictures: {options.checkpoint} holds no pictures")
    network, reason = None, "not asked for"
    if options.lpips:
        reason = None if lpips_available() else f"no weights; fetch them with: {FETCH}"
        network = None if reason else load_lpips().to(device)
    protocol = ViewsProtocol(
        split=options.split,
        split_version=dataset.split_version,
        reference=options.reference,
        views=options.views,
        size=gso.SIZE if evaluation else options.size,
        lpips="VGG16, version 0.1" if network else None,
        lpips_reason=reason,
        distance=predictions.distance,
        evaluation=evaluation,
        resize_pictures=options.resize_pictures,
        **rendered,
    )
    job = Job(predictions, dataset, uids, protocol, network, device)
    for name in evaluation["missing"] if evaluation else ():
        job.fail(name, f"an object of --protocol gso that is not in {options.data}")
    folder = None if options.out is None else output_folder(options.out)
    ceiling = {}
    if options.ceiling is not None:
        ceiling["ceiling"] = open_ceiling(
            *(options.ceiling, dataset, uids, protocol),
            device=device,
            out=folder,
            steps=options.ceiling_steps,
        )
    if options.baselines:
        _add_baselines(job, options)
    job.baselines |= ceiling
    return job


def _check_outputs(options: ViewsOptions, uids: list[str]) -> None:
    """Raises UserError where a file of this evaluation would replace one that it reads."""
    if options.out is None:
        return
    if options.save_pictures:
        made = (options.out / "pictures").resolve()
        if made in (options.checkpoint.resolve(), *options.checkpoint.resolve().parents):
            raise UserError(f"{options.checkpoint}: would be overwritten; give another --out")
    targets = [options.out / "strips" / f"{uid}.png" for uid in uids[: options.strips]]
    for name in ("gaussians", "retrieval"):
        if getattr(options, f"save_{name}"):
            targets += [options.out / name / f"{uid}.ply" for uid in uids]
    read = [options.checkpoint / f"{uid}.ply" for uid in uids]
    if options.save_retrieval:
        read += [mesh.path for mesh in find_meshes(options.save_retrieval)]
    check_not_read(targets, [*read, *(options.data / uid for uid in uids)])


def _add_baselines(job: Job, options: ViewsOptions) -> None:
    """Adds the four that need no fit; the retrieval only where there is a training split.

    Raises:
        UserError: meshes of the training objects are asked for, and cannot be had.
    """
    job.baselines |= {"background": background, "input_copy": input_copy, "billboard": billboard}
    try:
        training = open_dataset(options.data, "train")
        if options.save_retrieval:
            job.meshes = TrainingMeshes(options.save_retrieval, training)
        job.baselines["retrieval"] = job.retrieval = Retrieval(training)
    except UserError as error:
        if options.save_retrieval:
            raise UserError(f"--save-retrieval: {error}") from error
        job.left_out["retrieval"] = str(error)
        return
    for uid, reason in job.retrieval.failures.items():
        job.fail(f"{uid} (retrieval)", reason)
