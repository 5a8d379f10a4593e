"""Depth networks so small that a test can make them, of transformers' own classes."""

from __future__ import annotations

from pathlib import Path

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
HEADS = {"num_hidden_layers": 4, "num_attention_heads": 2, "hidden_size": 16}
NECK = {"neck_hidden_sizes": [8, 8, 8, 8]}
DINOV2 = {
    **HEADS, "mlp_ratio": 2, "image_size": 28, "patch_size": 14, "out_indices": [1, 2, 3, 4],
    "reshape_hidden_states": False,
}  # fmt: skip
BEIT = {
    **HEADS, "image_size": 32, "patch_size": 16, "intermediate_size": 32,
    "reshape_hidden_states": False, "use_relative_position_bias": True,
    "out_features": ["stage1", "stage2", "stage3", "stage4"],
}  # fmt: skip
ANYTHING = {**NECK, "reassemble_hidden_size": 16, "fusion_hidden_size": 8, "head_hidden_size": 4}
BY_14 = {
    "size": {"height": 56, "width": 56}, "keep_aspect_ratio": True, "ensure_multiple_of": 14,
    "resample": 3, **IMAGENET,
}  # fmt: skip
SAVED = {
    "depth_anything": ("DepthAnything", ANYTHING, BY_14),
    "dpt": (
        "DPT",
        {
            **HEADS, **NECK, "intermediate_size": 32, "image_size": 32, "patch_size": 16,
            "fusion_hidden_size": 16, "backbone_out_indices": [0, 1, 2, 3],
        },
        {"size": {"height": 32, "width": 32}},
    ),
    # As published for NYU and KITTI: not resized, padded to whole patches.
    "dpt_on_dinov2": (
        "DPT",
        {**NECK, "fusion_hidden_size": 16},
        {"do_resize": False, "do_pad": True, "size_divisor": 14, **IMAGENET},
    ),
    "glpn": (
        "GLPN",
        {
            "num_encoder_blocks": 2, "depths": [1, 1], "sr_ratios": [2, 1], "strides": [4, 2],
            "hidden_sizes": [8, 16], "patch_sizes": [7, 3], "num_attention_heads": [1, 2],
            "mlp_ratios": [2, 2], "decoder_hidden_size": 8,
        },
        {},
    ),
    "zoedepth": (
        "ZoeDepth",
        {
            **NECK, "fusion_hidden_size": 8, "bottleneck_features": 8, "bin_embedding_dim": 8,
            "num_relative_features": 4, "num_attractors": [4, 2, 2, 1],
            "bin_configurations": [
                {"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}
            ],
        },
        {"size": {"height": 64, "width": 96}, "ensure_multiple_of": 32},
    ),
}  # fmt: skip
"""Networks by name: the kind and configuration of each, and of its image processor."""


def save_network(name: str, folder: Path) -> Path:
    """Save a network with random weights, large enough to make a map that is not flat."""
    import torch
    import transformers

    kind, options, sizes = SAVED[name]
    processor = "DPT" if kind == "DepthAnything" else kind
    if kind == "DepthAnything" or name == "dpt_on_dinov2":
        options = {**options, "backbone_config": transformers.Dinov2Config(**DINOV2)}
    elif kind == "ZoeDepth":
        options = {**options, "backbone_config": transformers.BeitConfig(**BEIT)}
    config = getattr(transformers, f"{kind}Config")(**options)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = getattr(transformers, f"{kind}ForDepthEstimation")(config)
        for weight in network.parameters():
            if weight.ndim > 1:
                torch.nn.init.normal_(weight, std=weight[0].numel() ** -0.5)
    network.save_pretrained(folder)
    getattr(transformers, f"{processor}ImageProcessorPil")(**sizes).save_pretrained(folder)
    return folder
