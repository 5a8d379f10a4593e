"""Depth networks so small that a test can make them, of transformers' own classes."""

from __future__ import annotations

from pathlib import Path

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}


def _dinov2(transformers):
    return transformers.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=28,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
    )


def _depth_anything(transformers, **options):
    config = transformers.DepthAnythingConfig(
        backbone_config=_dinov2(transformers),
        reassemble_hidden_size=16,
        neck_hidden_sizes=[8, 8, 8, 8],
        **{"fusion_hidden_size": 8, "head_hidden_size": 4, **options},
    )
    size = {"height": 56, "width": 56}
    processor = transformers.DPTImageProcessorPil(
        size=size, keep_aspect_ratio=True, ensure_multiple_of=14, resample=3, **IMAGENET
    )
    return transformers.DepthAnythingForDepthEstimation(config), processor


def _depth_anything_metric(transformers):
    return _depth_anything(transformers, depth_estimation_type="metric", max_depth=20)


def _dpt(transformers):
    config = transformers.DPTConfig(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=32,
        patch_size=16,
        fusion_hidden_size=16,
        backbone_out_indices=[0, 1, 2, 3],
        neck_hidden_sizes=[8, 8, 8, 8],
    )
    processor = transformers.DPTImageProcessorPil(size={"height": 32, "width": 32})
    return transformers.DPTForDepthEstimation(config), processor


def _dpt_on_dinov2(transformers):
    """As published for NYU and KITTI: not resized, padded to whole patches."""
    config = transformers.DPTConfig(
        backbone_config=_dinov2(transformers),
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=16,
    )
    processor = transformers.DPTImageProcessorPil(
        do_resize=False, do_pad=True, size_divisor=14, **IMAGENET
    )
    return transformers.DPTForDepthEstimation(config), processor


def _glpn(transformers):
    config = transformers.GLPNConfig(
        num_encoder_blocks=2,
        depths=[1, 1],
        sr_ratios=[2, 1],
        hidden_sizes=[8, 16],
        patch_sizes=[7, 3],
        strides=[4, 2],
        num_attention_heads=[1, 2],
        mlp_ratios=[2, 2],
        decoder_hidden_size=8,
    )
    return transformers.GLPNForDepthEstimation(config), transformers.GLPNImageProcessorPil()


def _zoedepth(transformers):
    backbone = transformers.BeitConfig(
        image_size=32,
        patch_size=16,
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        reshape_hidden_states=False,
        use_relative_position_bias=True,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )
    bins = {"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}
    config = transformers.ZoeDepthConfig(
        backbone_config=backbone,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        bottleneck_features=8,
        num_relative_features=4,
        bin_embedding_dim=8,
        num_attractors=[4, 2, 2, 1],
        bin_configurations=[bins],
    )
    processor = transformers.ZoeDepthImageProcessorPil(
        size={"height": 64, "width": 96}, ensure_multiple_of=32
    )
    return transformers.ZoeDepthForDepthEstimation(config), processor


SAVED = {
    "depth_anything": _depth_anything,
    "depth_anything_metric": _depth_anything_metric,
    "dpt": _dpt,
    "dpt_on_dinov2": _dpt_on_dinov2,
    "glpn": _glpn,
    "zoedepth": _zoedepth,
}
"""Networks by name: what makes each, and its image processor."""


def save_network(name: str, folder: Path) -> Path:
    """Save a network with random weights, large enough to make a map that is not flat."""
    import torch
    import transformers

    with torch.random.fork_rng():
        torch.manual_seed(0)
        network, processor = SAVED[name](transformers)
        for weight in network.parameters():
            if weight.ndim > 1:
                torch.nn.init.normal_(weight, std=weight[0].numel() ** -0.5)
    network.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder
