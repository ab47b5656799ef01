"""Random models of the kinds that `prior=sd15` loads, as small as their classes allow."""

import json
from pathlib import Path

import torch

CHANNELS = (8, 16)
WORDS = ["<|startoftext|>", "<|endoftext|>", "l", "o", "w", "l</w>", "o</w>", "w</w>", "lo", "low</w>"]


def write_tiny_inpainting(folder: Path, seed: int = 0) -> None:
    """Writes an inpainting pipeline without a safety checker."""
    from diffusers import AutoencoderKL, PNDMScheduler, StableDiffusionInpaintPipeline, UNet2DConditionModel
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
        block_out_channels=CHANNELS, layers_per_block=1, sample_size=16, in_channels=9, out_channels=4,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=8, attention_head_dim=2, norm_num_groups=4,
    )  # fmt: skip
    vae = AutoencoderKL(
        block_out_channels=(8, 8, 8, 8), in_channels=3, out_channels=3, latent_channels=4, norm_num_groups=4,
        down_block_types=["DownEncoderBlock2D"] * 4, up_block_types=["UpDecoderBlock2D"] * 4,
    )  # fmt: skip
    scheduler = PNDMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", steps_offset=1, skip_prk_steps=True
    )
    pipeline = StableDiffusionInpaintPipeline(
        vae=vae, text_encoder=text, tokenizer=tokenizer, unet=unet, scheduler=scheduler, safety_checker=None,
        feature_extractor=None, requires_safety_checker=False,
    )  # fmt: skip
    # as the published folder has them: half precision only
    pipeline.to(torch.float16).save_pretrained(folder, safe_serialization=True, variant="fp16")


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


def write_tiny_models(root: Path) -> dict[str, str]:
    """Writes all three under a folder; returns the settings that name them."""
    write_tiny_inpainting(root / "inpainting")
    write_tiny_controlnet(root / "controlnet")
    write_tiny_segmenter(root / "segmenter")
    return {name: str(root / name) for name in ("inpainting", "controlnet", "segmenter")}
