"""Random models of the kinds that `prior=sd15` loads, as small as their classes allow, laid out as they are published.

What today's libraries save differs from what lies in the published folders: names of tensors and of files, classes
that are gone, half precision. The functions here undo that, so that loading is tested on the older layout.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

CHANNELS = (8, 16)
WORDS = ["<|startoftext|>", "<|endoftext|>", "l", "o", "w", "l</w>", "o</w>", "w</w>", "lo", "low</w>"]


def write_tiny_inpainting(folder: Path, seed: int = 0, channels_in: int = 9) -> None:
    """Writes an inpainting pipeline without a safety checker; with 4 channels in, the plain model."""
    from diffusers import AutoencoderKL, DDIMScheduler, StableDiffusionInpaintPipeline, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    torch.manual_seed(seed)
    vocabulary = folder.parent / f"{folder.name}-vocabulary"
    vocabulary.mkdir(parents=True)
    (vocabulary / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(WORDS)}))
    (vocabulary / "merges.txt").write_text("#version: 0.2\nl o\nlo w</w>\n")
    tokenizer = CLIPTokenizer(
        str(vocabulary / "vocab.json"), str(vocabulary / "merges.txt"), model_max_length=77
    )
    text = CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(WORDS), hidden_size=8, intermediate_size=8, num_hidden_layers=1,
            num_attention_heads=2, bos_token_id=0, eos_token_id=1, pad_token_id=1,
        )
    )  # fmt: skip
    unet = UNet2DConditionModel(
        block_out_channels=CHANNELS, layers_per_block=1, sample_size=16, in_channels=channels_in, out_channels=4,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=8, attention_head_dim=2, norm_num_groups=4,
    )  # fmt: skip
    vae = AutoencoderKL(
        block_out_channels=(8, 8, 8, 8), in_channels=3, out_channels=3, latent_channels=4, norm_num_groups=4,
        down_block_types=["DownEncoderBlock2D"] * 4, up_block_types=["UpDecoderBlock2D"] * 4,
    )  # fmt: skip
    scheduler = DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", steps_offset=1, clip_sample=False,
        set_alpha_to_one=False,
    )  # fmt: skip
    pipeline = StableDiffusionInpaintPipeline(
        vae=vae, text_encoder=text, tokenizer=tokenizer, unet=unet, scheduler=scheduler, safety_checker=None,
        feature_extractor=None, requires_safety_checker=False,
    )  # fmt: skip
    for part in (unet, vae, text):
        part.to(torch.float16)
    pipeline.save_pretrained(folder, safe_serialization=True, variant="fp16")
    weights = folder / "text_encoder" / "model.fp16.safetensors"
    tensors = {f"text_model.{name}": tensor for name, tensor in load_file(weights).items()}
    tensors["text_model.embeddings.position_ids"] = torch.arange(77)[None]
    save_file(tensors, weights, metadata={"format": "pt"})
    (folder / "tokenizer" / "tokenizer.json").unlink()
    for name in ("vocab.json", "merges.txt"):
        (vocabulary / name).rename(folder / "tokenizer" / name)
    _edit(
        folder / "model_index.json",
        feature_extractor=["transformers", "CLIPFeatureExtractor"],
        safety_checker=["stable_diffusion", "StableDiffusionSafetyChecker"],
        image_encoder=None,
        requires_safety_checker=None,
    )


def write_tiny_controlnet(folder: Path, seed: int = 1) -> None:
    from diffusers import ControlNetModel

    torch.manual_seed(seed)
    control = ControlNetModel(
        block_out_channels=CHANNELS, layers_per_block=1, in_channels=4, cross_attention_dim=8,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), attention_head_dim=2, norm_num_groups=4,
        conditioning_embedding_out_channels=(4, 4, 4, 4),
    )  # fmt: skip
    for name, parameter in control.named_parameters():
        if "controlnet_" in name:  # these start at zero, with which the canvas would change nothing
            torch.nn.init.normal_(parameter, std=0.1)
    control.save_pretrained(folder, safe_serialization=True)


def write_tiny_segmenter(folder: Path, seed: int = 2) -> None:
    from transformers import SamHQConfig, SamHQModel, SamHQProcessor
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    torch.manual_seed(seed)
    config = SamHQConfig(
        vision_config={
            "hidden_size": 16, "output_channels": 16, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": 64, "patch_size": 8, "mlp_dim": 16, "window_size": 4, "global_attn_indexes": [0, 1],
            "num_pos_feats": 8,
        },
        prompt_encoder_config={"hidden_size": 16, "image_size": 64, "patch_size": 8, "mask_input_channels": 4},
        mask_decoder_config={
            "hidden_size": 16, "mlp_dim": 16, "num_hidden_layers": 2, "num_attention_heads": 2,
            "iou_head_hidden_dim": 16, "vit_dim": 16,
        },
    )  # fmt: skip
    model = SamHQModel(config)
    for parameter in model.parameters():
        if parameter.dim() > 1:  # as they start, masks are 0.5 everywhere
            torch.nn.init.normal_(parameter, std=0.3)
    model.save_pretrained(folder, safe_serialization=True)
    size = {"height": 64, "width": 64}
    processor = SamImageProcessorPil(size={"longest_edge": 64}, pad_size=size, mask_size={"longest_edge": 16})
    SamHQProcessor(processor).save_pretrained(folder)
    saved = json.loads((folder / "processor_config.json").read_text())
    (folder / "processor_config.json").unlink()
    older = {**saved["image_processor"], "processor_class": "SamHQProcessor"}
    (folder / "preprocessor_config.json").write_text(json.dumps(older))


def _edit(path: Path, **changes: Any) -> None:
    """Changes keys of a JSON file; None takes a key out."""
    content = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def write_tiny_painter(root: Path) -> dict[str, str]:
    """Writes the two that inpaint under a folder; returns the settings that name them."""
    write_tiny_inpainting(root / "inpainting")
    write_tiny_controlnet(root / "controlnet")
    return {name: str(root / name) for name in ("inpainting", "controlnet")}


def write_tiny_models(root: Path) -> dict[str, str]:
    """Writes all three under a folder; returns the settings that name them."""
    painter = write_tiny_painter(root)
    write_tiny_segmenter(root / "segmenter")
    return {**painter, "segmenter": str(root / "segmenter")}
