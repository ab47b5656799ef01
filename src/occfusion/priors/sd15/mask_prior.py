"""The Stable Diffusion mask prior: inpaint the picture of the person, then segment it (paper §4.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.observation.frames import Observation
from occfusion.observation.keypoints import Keypoints
from occfusion.priors.masks import MaskPrior
from occfusion.priors.sd15.canvas import draw_keypoints
from occfusion.priors.sd15.loading import load_segmenter
from occfusion.priors.sd15.model_folder import SEGMENTER, find_model, fingerprint
from occfusion.priors.sd15.pipeline import (
    as_planes,
    find_inpainting,
    frame_seed,
    inpainting_hashes,
    make_pipeline,
    resolve_placement,
)
from occfusion.priors.sd15.region import Region, body_keypoints, body_region
from occfusion.priors.sd15.settings import DTYPES, NO_EFFECT, Sd15Settings

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
        self.device, self.dtype = resolve_placement(settings, device)
        folders = find_inpainting(settings)
        segmenter = find_model(
            SEGMENTER, settings.segmenter, settings.segmenter_revision, settings.local_files_only
        )
        self.hashes = {**inpainting_hashes(folders), "segmenter_hash": fingerprint(segmenter, SEGMENTER)}
        self.pipeline = make_pipeline(folders, settings, settings.sampler, self.device, self.dtype)
        self.segmenter, self.processor = load_segmenter(segmenter, DTYPES[self.dtype])
        if not settings.cpu_offload:
            self.segmenter.to(self.device)

    def describe(self) -> dict[str, Any]:
        """Returns what decides the masks: prompts, sampling, precision, and the hashes of the models."""
        own = {key: value for key, value in vars(self.settings).items() if key not in NO_EFFECT}
        return {"prior": self.name, **own, "dtype": self.dtype, **self.hashes}

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
        return body_region(observation, self.settings.margin, self.settings.resolution)

    def keypoints(self, observation: Observation, region: Region) -> Keypoints:
        """Returns the key points in a region at work, without those that the body itself hides."""
        return body_keypoints(observation, region, self.settings.self_occlusion)

    @torch.no_grad()
    def inpaint(self, observation: Observation, region: Region, seen: Keypoints) -> Picture:
        """Returns the region with all but the visible part of the person made up, `[h, w, 3]`, 0..1."""
        settings = self.settings
        mask = observation.visible[..., None]
        picture = region.take(np.where(mask, observation.rgb, 1.0).astype(np.float32), outside=1.0)
        hidden = region.take((~observation.visible).astype(np.float32), outside=1.0) > 0.5
        canvas = draw_keypoints(seen, region.work_width, region.work_height).astype(np.float32) / 255.0
        result = self.pipeline(
            prompt=settings.prompt, negative_prompt=settings.negative_prompt, image=as_planes(picture),
            mask_image=as_planes(hidden[..., None].astype(np.float32)), control_image=as_planes(canvas),
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
        best = masks[0][0, int(scores.argmax())] + 0.0 * scores.sum().cpu()  # passes on a score that is NaN
        return np.asarray(torch.sigmoid(best), np.float32)


def prompts(seen: Keypoints, region: Region) -> NDArray[np.float64]:
    """Returns the shown key points inside a region at work, `[P, 2]`, as SAM takes them: pixel centres at 0."""
    size = (region.work_width, region.work_height)
    inside = seen.shown & (seen.pixels >= 0).all(axis=1) & (seen.pixels < size).all(axis=1)
    return seen.pixels[inside] - 0.5
