"""Where the files of a published model lie, checked before anything is loaded; only safetensors are read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from occfusion.errors import DataError

WHOLE = 64 * 2**20
"""Bytes up to which a file is hashed whole; of a larger one, samples."""
SAMPLES = 32
SAMPLE = 2**20


@dataclass(frozen=True)
class ModelKind:
    """What a model's folder must hold.

    Attributes:
        setting: the setting that names the folder or id.
        published: id of the model that the paper used.
        files: files that must be there; of each entry, one that older or newer libraries write.
        weights: stems of weight files; each is there as `stem.safetensors`, `stem.fp16.safetensors` or in shards.
        about: what errors say of the published one: size and licence.
    """

    setting: str
    published: str
    files: tuple[tuple[str, ...], ...]
    weights: tuple[str, ...]
    about: str

    @property
    def patterns(self) -> list[str]:
        """Returns the files that are downloaded: settings, vocabularies, and safetensors where they belong.

        The hub's `*` goes beyond a slash, so those at the root are named.
        """
        files = sum(self.files, ())
        found = [name for name in files if "/" not in name]
        for stem in (name for name in self.weights if "/" not in name):
            found += [f"{stem}*.safetensors", f"{stem}*.index.json"]
        for folder in sorted({name.rpartition("/")[0] for name in (*files, *self.weights)} - {""}):
            found += [f"{folder}/*.{ending}" for ending in ("json", "txt", "safetensors")]
        return found


INPAINTING = ModelKind(
    "prior.inpainting",
    "stable-diffusion-v1-5/stable-diffusion-inpainting",
    (
        ("model_index.json",),
        ("scheduler/scheduler_config.json",),
        ("tokenizer/vocab.json", "tokenizer/tokenizer.json"),
    ),
    ("unet/diffusion_pytorch_model", "vae/diffusion_pytorch_model", "text_encoder/model"),
    "2.1 GB, licence CreativeML OpenRAIL-M",
)
CONTROLNET = ModelKind(
    "prior.controlnet",
    "lllyasviel/sd-controlnet-openpose",
    (("config.json",),),
    ("diffusion_pytorch_model",),
    "1.4 GB, licence OpenRAIL",
)
SEGMENTER = ModelKind(
    "prior.segmenter",
    "syscv-community/sam-hq-vit-huge",
    (("config.json",), ("preprocessor_config.json", "processor_config.json")),
    ("model",),
    "2.6 GB, licence Apache-2.0",
)
SCORE_MODEL = ModelKind(
    "prior.score.model",
    "stable-diffusion-v1-5/stable-diffusion-v1-5",
    INPAINTING.files,
    INPAINTING.weights,
    "2.1 GB, licence CreativeML OpenRAIL-M",
)
SCORE_CONTROLNET = ModelKind(
    "prior.score.controlnet",
    "lllyasviel/control_v11p_sd15_openpose",
    CONTROLNET.files,
    CONTROLNET.weights,
    "1.4 GB, licence OpenRAIL",
)


def find_model(kind: ModelKind, source: str, revision: str | None, local_files_only: bool) -> Path:
    """Returns the folder of a model: `source` itself, or the cached snapshot of the id that it names.

    Raises:
        DataError: it is not there, is incomplete, or holds pickles only; says what to download and how.
    """
    folder = Path(source).expanduser()
    if not folder.is_dir():
        folder = _snapshot(kind, source, revision, local_files_only)
    missing = [names[0] for names in kind.files if not any((folder / name).is_file() for name in names)]
    missing += [f"{stem}.safetensors" for stem in kind.weights if not any(_weight_files(folder, stem))]
    if missing:
        pickles = any(list((folder / stem).parent.glob("*.bin")) for stem in kind.weights)
        raise DataError(
            f"{kind.setting}={source}: {folder} lacks {', '.join(missing)}"
            + ("; its .bin files are pickles, which can run code and are never read" if pickles else "")
            + f". {advice(kind, source, revision)}"
        )
    return folder


def variant_of(kind: ModelKind, folder: Path) -> str | None:
    """Returns "fp16" where a model's weights are there in half precision only (they load in any), else None."""
    plain = all(any(_weight_files(folder, stem, "")) for stem in kind.weights)
    return None if plain else "fp16"


def fingerprint(folder: Path, kind: ModelKind) -> str:
    """Returns a hash of a model's settings and weights; of weights above 64 MiB, 32 MiB in samples are read."""
    digest = hashlib.sha256()
    names = {path for pattern in kind.patterns for path in folder.glob(pattern) if path.is_file()}
    for path in sorted(names):
        size = path.stat().st_size
        digest.update(f"{path.relative_to(folder)} {size}\n".encode())
        with path.open("rb") as file:
            if size <= WHOLE:
                digest.update(file.read())
                continue
            for k in range(SAMPLES):
                file.seek(k * (size - SAMPLE) // (SAMPLES - 1))
                digest.update(file.read(SAMPLE))
    return digest.hexdigest()[:16]


def advice(kind: ModelKind, source: str, revision: str | None) -> str:
    """Returns how to get a model."""
    wanted, at = (source, revision) if _is_id(source) else (kind.published, None)
    excluded = ["*.bin", "*.ckpt", *(["safety_checker/*"] if kind in (INPAINTING, SCORE_MODEL) else [])]
    options = [f"--revision {at}"] * bool(at) + [f'--exclude "{pattern}"' for pattern in excluded]
    return (
        f"Get it ({kind.about}) with: hf download {wanted} {' '.join(options)} -- or have the run "
        f"download it: {kind.setting}={wanted} prior.local_files_only=false; or name a folder that holds it. "
        f"prior=embedded needs no download"
    )


def _weight_files(folder: Path, stem: str, variant: str | None = None) -> Iterator[Path]:
    """Yields the files of some weights: plain (variant ""), half precision ("fp16"), or either (None)."""
    for dotted in ("", ".fp16") if variant is None else (f".{variant}" if variant else "",):
        yield from folder.glob(f"{stem}{dotted}.safetensors")
        yield from folder.glob(f"{stem}{dotted}-*-of-*.safetensors")


def _snapshot(kind: ModelKind, source: str, revision: str | None, local_files_only: bool) -> Path:
    """Returns the folder of a model in the cache of huggingface_hub; downloads it if that is allowed."""
    from huggingface_hub import snapshot_download

    if not _is_id(source):
        raise DataError(f"{kind.setting}={source}: there is no such folder. {advice(kind, source, revision)}")
    try:
        found = snapshot_download(
            source, revision=revision, allow_patterns=kind.patterns, local_files_only=local_files_only
        )
    except (OSError, ValueError) as error:
        reason = (
            "is not (or not whole) on this machine"
            if local_files_only
            else f"was not downloaded: {_first_line(error)}"
        )
        raise DataError(f"{kind.setting}={source} {reason}. {advice(kind, source, revision)}") from error
    return Path(found)


def _is_id(source: str) -> bool:
    return source.count("/") == 1 and not source.startswith((".", "/", "~")) and not Path(source).is_dir()


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
