"""The Stable Diffusion mask prior: inpaint the picture of the person, then segment it (paper §4.1)."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import ConfigError
from occfusion.priors.bodyview import project, view_body
from occfusion.priors.canvas import draw_keypoints
from occfusion.priors.keypoints import Keypoints, see_keypoints
from occfusion.priors.masks import MaskPrior, Observation
from occfusion.priors.model_folder import CONTROLNET, INPAINTING, SEGMENTER, find_model, fingerprint
from occfusion.priors.region import Region
from occfusion.priors.sd15_models import load_inpainting, load_segmenter, require_packages
from occfusion.priors.sd15_settings import DTYPES, NO_EFFECT, Sd15Settings, resolve_device

__all__ = ["Sd15MaskPrior", "Sd15Settings"]

Picture = NDArray[np.float32]


class Sd15MaskPrior(MaskPrior):
    """Inpaints the hidden part of each frame under a skeleton and segments the person with SAM-HQ.

    Args:
        settings: models, prompts and sampling.
        device: where the models run, unless the settings say it.

    Raises:
        ConfigError: a package is missing, or a setting is wrong.
        DataError: a model is missing, incomplete or damaged.
    """

    name = "sd15"

    def __init__(self, settings: Sd15Settings, device: torch.device | str = "cpu") -> None:
        self.settings = settings
        self.device = resolve_device(settings.device, settings.dtype, device)
        if settings.cpu_offload and self.device.type == "cpu":
            raise ConfigError(
                "setting prior.cpu_offload=true: nothing runs on a GPU, so there is nothing to offload"
            )
        require_packages(settings.cpu_offload)
        folders = [
            find_model(kind, source, revision, settings.local_files_only)
            for kind, source, revision in (
                (INPAINTING, settings.inpainting, settings.inpainting_revision),
                (CONTROLNET, settings.controlnet, settings.controlnet_revision),
                (SEGMENTER, settings.segmenter, settings.segmenter_revision),
            )
        ]
        auto = "float32" if self.device.type == "cpu" else "float16"
        self.dtype = auto if settings.dtype == "auto" else settings.dtype
        dtype = DTYPES[self.dtype]
        self.hashes = [
            fingerprint(*pair) for pair in zip(folders, (INPAINTING, CONTROLNET, SEGMENTER), strict=True)
        ]
        self.pipeline = load_inpainting(folders[0], folders[1], settings.sampler, dtype)
        self.segmenter, self.processor = load_segmenter(folders[2], dtype)
        if settings.attention_slicing:
            self.pipeline.enable_attention_slicing()
        if settings.vae_slicing:
            self.pipeline.vae.enable_slicing()
        if settings.cpu_offload:
            self.pipeline.enable_model_cpu_offload(device=self.device)
        else:
            self.pipeline.to(self.device)
            self.segmenter.to(self.device)

    def describe(self) -> dict[str, Any]:
        """Returns what decides the masks: prompts, sampling, precision, and the hashes of the models."""
        own = {key: value for key, value in vars(self.settings).items() if key not in NO_EFFECT}
        hashes = zip(("inpainting_hash", "controlnet_hash", "segmenter_hash"), self.hashes, strict=True)
        return {"prior": self.name, **own, "dtype": self.dtype, **dict(hashes)}

    def probability(self, observation: Observation) -> NDArray[np.float32]:
        """Returns the probability of the person, `[H, W]`; 0 outside the region, and where no joint is seen.

        What the models made not finite is NaN in all of the region.
        """
        height, width = observation.visible.shape
        region = self.region(observation)
        if region is None:
            return np.zeros((height, width), np.float32)
        seen = self.keypoints(observation, region)
        points = prompts(seen, region)
        if len(points) == 0:
            return np.zeros((height, width), np.float32)
        filled = self.inpaint(observation, region, seen)
        if not np.isfinite(filled).all():
            window = np.full(filled.shape[:2], np.nan, np.float32)
        else:
            window = self.segment(filled, points)
        return region.put(window, width, height)

    def region(self, observation: Observation) -> Region | None:
        """Returns where a frame is inpainted; None where its body is outside the picture."""
        camera = observation.camera
        pixels, depths = project(
            observation.vertices, camera.viewmat.double().numpy(), camera.K.double().numpy()
        )
        height, width = observation.visible.shape
        return Region.around(
            pixels[depths > 0.01], (width, height), self.settings.margin, self.settings.resolution
        )

    def keypoints(self, observation: Observation, region: Region) -> Keypoints:
        """Returns the key points in a region at work, without those that the body itself hides."""
        camera = region.camera(observation.camera)
        projected = project(observation.vertices, camera.viewmat.double().numpy(), camera.K.double().numpy())
        depth = view_body(*projected, observation.faces, camera.width, camera.height).depth
        return see_keypoints(
            torch.from_numpy(observation.keypoints), camera, depth, self.settings.self_occlusion
        )

    @torch.no_grad()
    def inpaint(self, observation: Observation, region: Region, seen: Keypoints) -> Picture:
        """Returns the region with all but the visible part of the person made up, `[h, w, 3]`, 0..1."""
        settings = self.settings
        mask = observation.visible[..., None]
        picture = region.take(np.where(mask, observation.rgb, 1.0).astype(np.float32), outside=1.0)
        hidden = region.take((~observation.visible).astype(np.float32), outside=1.0) > 0.5
        canvas = draw_keypoints(seen, region.work_width, region.work_height).astype(np.float32) / 255.0
        result = self.pipeline(
            prompt=settings.prompt, negative_prompt=settings.negative_prompt, image=_planes(picture),
            mask_image=_planes(hidden[..., None].astype(np.float32)), control_image=_planes(canvas),
            width=region.work_width, height=region.work_height, num_inference_steps=settings.steps,
            guidance_scale=settings.guidance, controlnet_conditioning_scale=settings.control_scale,
            generator=torch.Generator().manual_seed(frame_seed(settings.seed, observation.name)), output_type="np",
        )  # fmt: skip
        return np.asarray(result.images[0], np.float32)

    @torch.no_grad()
    def segment(self, picture: Picture, points: NDArray[np.float64]) -> Picture:
        """Returns how probable each pixel of a picture `[h, w, 3]` is to show what the points lie on, `[h, w]`.

        Of SAM-HQ's masks it is the one whose IoU the model itself predicts to be highest.
        """
        inputs = self.processor(
            images=np.uint8(255.0 * picture + 0.5), input_points=[[points.tolist()]], return_tensors="pt"
        )
        if self.settings.cpu_offload:
            self.segmenter.to(self.device)
        output = self.segmenter(
            pixel_values=inputs["pixel_values"].to(self.device, DTYPES[self.dtype]),
            input_points=inputs["input_points"].to(self.device, torch.float32), multimask_output=True,
        )  # fmt: skip
        if self.settings.cpu_offload:
            self.segmenter.to("cpu")
        masks = self.processor.post_process_masks(
            output.pred_masks.float().cpu(),
            inputs["original_sizes"],
            inputs["reshaped_input_sizes"],
            binarize=False,
        )
        scores = output.iou_scores[0, 0].float()
        best = (
            masks[0][0, int(scores.argmax())] + 0.0 * scores.sum().cpu()
        )  # a score that is NaN is passed on
        return np.asarray(torch.sigmoid(best), np.float32)


def prompts(seen: Keypoints, region: Region) -> NDArray[np.float64]:
    """Returns the shown key points inside a region at work, `[P, 2]`, as SAM takes them: pixel centres at 0."""
    size = (region.work_width, region.work_height)
    inside = seen.shown & (seen.pixels >= 0).all(axis=1) & (seen.pixels < size).all(axis=1)
    return seen.pixels[inside] - 0.5


def frame_seed(seed: int, name: str) -> int:
    """Returns the seed of a frame's noise: the same on each machine and in each run."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:7], "big")


def _planes(picture: Picture) -> torch.Tensor:
    """Returns a picture `[h, w, C]` as a batch `[1, C, h, w]`."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))[None]
