"""Trained systems as folders in the format of the Hugging Face Hub: config.json, model.safetensors and README.md."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from kornia_tidy.choices import PRETRAINED
from kornia_tidy.files import error_prefix, output_folder, read_json, standard, write_bytes
from kornia_tidy.reconstruction.half_precision import halved
from kornia_tidy.reconstruction.model_card import check_license, model_card
from kornia_tidy.reconstruction.settings import RENAMED
from kornia_tidy.reconstruction.trained import TrainedSystem, below, psfs_to_store, system_of_state
from kornia_tidy.search_path import import_extra
from kornia_tidy.tensor_files import read_tensors

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"  # the names of huggingface_hub's mixins
PSFS = "psfs."  # begins the names of measured PSFs
LIBRARY, FORMAT = "kornia_tidy", "kornia_tidy system 1"
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")


def save_pretrained(
    system: TrainedSystem,
    save_directory: str | os.PathLike[str],
    *,
    record: Mapping[str, Any] | None = None,
    license: str | None = None,  # noqa: A002 (the name in the card's metadata)
    half: bool = False,
) -> Path:
    """Write a trained system as a folder that :func:`from_pretrained` loads and the Hugging Face Hub takes.

    ``hf upload OWNER/NAME FOLDER`` publishes the folder. Nothing is sent from here.

    Args:
        system: camera and network, such as :func:`~kornia_tidy.reconstruction.trained.load_trained` returns.
        save_directory: the folder, made if missing. It gets ``config.json`` (settings, steps and record),
            ``model.safetensors`` (weights) and, unless it has one, ``README.md`` (model card).
        record: of the training, as plain values: ``"scores"`` by test set, and whatever else should be told. Default:
            the system's own. :func:`kornia_tidy.training.record.training_record` reads it from the folder of a run,
            :func:`kornia_tidy.reconstruction.pretrained.pretrained_record` from a shipped system.
        license: identifier of the weights' licence, such as ``"apache-2.0"``. Default: the card says that none is
            given.
        half: write the network's weights as float16, in half the space; see
            :func:`~kornia_tidy.reconstruction.half_precision.halved`. They are loaded as float32.

    Returns:
        The folder.

    Raises:
        ValueError: if the settings do not describe camera and network, a value cannot be written as JSON, or a weight
            is beyond the range of float16 and that is asked for; nothing is then written.
        OSError: if a file cannot be written.

    Convention:
        - Names and layout are those of ``huggingface_hub.ModelHubMixin``. Weights have the names of the camera's and
          the network's states after ``optics.`` and ``head.``, measured PSFs those of a bank after ``psfs.``.
        - ``config.json`` is standard JSON: infinity is written as the text ``"inf"``. The folder that the training data
          lay in (``root``) is left out.

    Example:
        >>> import tempfile
        >>> from kornia_tidy.reconstruction.pretrained import load_pretrained, pretrained_record
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_pretrained(load_pretrained("edof-5"), folder, record=pretrained_record("edof-5"))
        ...     print(sorted(path.name for path in Path(folder).iterdir()))
        ...     system = from_pretrained(folder)
        ['README.md', 'config.json', 'model.safetensors']
        >>> system.settings.task, system.step > 0
        ('edof', True)
    """
    folder = output_folder(save_directory)
    check_license(license)
    weights = _weights(system)
    if half:
        weights = halved(weights, [f"head.{name}" for name, _ in system.head.named_parameters()])
    config = {
        "library_name": LIBRARY,
        "format": FORMAT,
        "settings": system.settings.as_dict(),
        "run": {name: None if name == "root" else value for name, value in system.run.items()},
        "global_step": system.step,
        "record": dict(system.record if record is None else record),
    }
    with error_prefix("record and run must be plain values for JSON", TypeError):
        text = json.dumps(standard(config), indent=2, allow_nan=False)
    read_back = _state(json.loads(text), weights, "the system")
    again = system_of_state(read_back, "the system")  # refuses settings that do not describe camera and network
    card = model_card(again._replace(record=config["record"]), folder.absolute().name, license)
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / WEIGHTS, save(weights, {"format": "pt"}))
    if not (folder / CARD).exists():  # a card that was edited is kept, as the mixins do
        write_bytes(folder / CARD, card.encode())
    write_bytes(folder / CONFIG, f"{text}\n".encode())
    return folder


def from_pretrained(
    pretrained_model_name_or_path: str | os.PathLike[str],
    *,
    revision: str | None = None,
    cache_dir: str | os.PathLike[str] | None = None,
    token: str | bool | None = None,
    local_files_only: bool = False,
    force_download: bool = False,
) -> TrainedSystem:
    """Load a trained system from a folder, or from a repository of the Hugging Face Hub.

    A folder needs neither network nor further packages; a repository needs ``pip install 'kornia-tidy[hub]'``. Nothing
    is unpickled, and no code is loaded.

    Args:
        pretrained_model_name_or_path: folder that :func:`save_pretrained` wrote, or ``"OWNER/NAME"``. A folder comes
            first, if there is one of that name.
        revision: branch, tag or commit of the repository. Default: its main branch.
        cache_dir: folder of downloaded files. Default: huggingface_hub's.
        token: for a repository that is not public.
        local_files_only: take files that were downloaded before, and do not connect.
        force_download: download again in any case.

    Returns:
        The system in eval mode, on the CPU, with the record of its training. The sensor keeps its noise.

    Raises:
        FileNotFoundError: if the folder or file is missing, and the name is not that of a repository.
        ImportError: if a repository is asked for and huggingface_hub is missing.
        OSError: if a repository or its files cannot be downloaded.
        ValueError: if files are damaged, or weights and settings do not fit; the message names the difference.
    """
    name = os.fspath(pretrained_model_name_or_path)
    folder = Path(name)
    if folder.is_dir():
        config, weights = folder / CONFIG, folder / WEIGHTS
    elif isinstance(pretrained_model_name_or_path, str) and _REPOSITORY.fullmatch(name) and not folder.exists():
        options = {"revision": revision, "cache_dir": cache_dir, "token": token}
        options |= {"local_files_only": local_files_only, "force_download": force_download}
        config, weights = (_download(name, file, options) for file in (CONFIG, WEIGHTS))
    else:
        raise FileNotFoundError(
            f"there is no folder {name}, and the name of a repository is OWNER/NAME; shipped systems are "
            f"{', '.join(PRETRAINED)}; for the network any-camera give the camera, a TiDyOptics or PSFBank"
        )
    values = read_json(config)
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        found = values.get("format") if isinstance(values, dict) else None
        raise ValueError(f"cannot read {config}: its format must be {FORMAT!r}, got {found!r:.80}")
    record = values.get("record", {})
    if not isinstance(record, dict):
        raise ValueError(f"cannot read {config}: record must be values by name, got {record!r:.80}")
    tensors, _ = read_tensors(weights)
    return system_of_state(_state(values, tensors, str(config)), weights)._replace(record=record)


def _weights(system: TrainedSystem) -> dict[str, Tensor]:
    """Return the weights of camera and network, copied, as safetensors refuses tensors that share memory."""
    parts = {"optics": system.optics, "head": system.head}
    return {
        f"{part}.{name}": value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for part, module in parts.items()
        for name, value in module.state_dict().items()
    } | {f"{PSFS}{name}": value.detach().cpu() for name, value in psfs_to_store(system.optics).items()}


def _state(config: Mapping[str, Any], weights: Mapping[str, Tensor], name: str) -> dict[str, Any]:
    """Return a state as a checkpoint holds it."""
    known: dict[str, Any] = {}
    for key in ("run", "settings"):
        value = config.get(key)
        if not isinstance(value, dict):
            raise ValueError(f"cannot read {name}: {key} must be values by name, got {value!r:.80}")
        known |= {RENAMED.get(one, one): own for one, own in value.items()}
    if isinstance(ends := known.get("depth_range"), list):
        known["depth_range"] = [math.inf if end == "inf" else end for end in ends]
    if known.get("focus_distance") == "inf":
        known["focus_distance"] = math.inf
    psfs, others = below(weights, PSFS), {k: v for k, v in weights.items() if not k.startswith(PSFS)}
    return {"settings": known, "global_step": config.get("global_step"), "state_dict": others, "psfs": psfs}


def _download(repository: str, file: str, options: Mapping[str, Any]) -> Path:
    """Return the path of a file of a repository, downloaded unless it is in the cache."""
    hub = import_extra("huggingface_hub", f"there is no folder {repository}, and the repository of this name")
    try:
        return Path(hub.hf_hub_download(repository, file, library_name=LIBRARY, **options))
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise OSError(f"cannot download {file} of the repository {repository}: {reason:.300}") from error
