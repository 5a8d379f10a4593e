"""Matrices as users write them, and models moved by them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io.matrices import parse_matrix, parse_similarity
from splatseed.similarity import Similarity
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import transform_gaussians, view_in_model_frame

TURN = Rotation.from_euler("xyz", [20, -50, 130], degrees=True).as_matrix()
MOVE = np.vstack([np.column_stack([2.5 * TURN, [1.0, -2.0, 3.0]]), [0, 0, 0, 1]])


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("kind", ["numbers", "text", "json", "mapping", "scaled"])
def test_a_matrix_is_read_as_written(kind, rows, tmp_path):
    path, matrix = tmp_path / "matrix.txt", MOVE[:rows]
    unscaled = np.column_stack([TURN, MOVE[:3, 3] / 2.5]).tolist()  # nerfstudio's
    if kind == "text":
        np.savetxt(path, matrix)
    elif kind != "numbers":
        content = {"mapping": {"matrix": matrix.tolist()}, "json": matrix.tolist()}
        content["scaled"] = {"transform": unscaled, "scale": 2.5}
        path.write_text(json.dumps(content[kind]))
    text = ", ".join(map(repr, matrix.ravel().tolist())) if kind == "numbers" else str(path)
    np.testing.assert_allclose(parse_matrix(text, "crop"), MOVE, atol=1e-12)
    similarity = parse_similarity(text)
    np.testing.assert_allclose(similarity.matrix, MOVE[:3], atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "found"),
    [
        (np.diag([1.0, 1, -1, 1]), "a mirror"),
        (np.diag([1.0, 1, 2, 1]), "scales by 1 to 2"),
        (np.array([[1.0, 0.3, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "scales by"),
        (np.diag([1.0, 1, 0, 1]), "flattens"),
        (MOVE.T, "Transpose"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.full((4, 4), np.nan), "16 numbers"),
        (np.eye(3), "9 numbers"),
    ],
)
def test_other_matrices_are_refused(matrix, found):
    with pytest.raises(ParameterError, match=found):
        parse_similarity(" ".join(map(str, matrix.ravel())))


def test_a_file_that_is_no_matrix_is_refused(tmp_path):
    for text in ("{}", "[[1, 2], [3]]", '{"matrix": "a"}', "hello", "\xff", "[" * 5000):
        (tmp_path / "m.json").write_text(text, "latin-1")
        with pytest.raises(ParameterError, match="`transform` as a matrix"):
            parse_similarity(str(tmp_path / "m.json"))
    with pytest.raises(SceneNotFoundError):
        parse_similarity(str(tmp_path / "none.txt"))


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_moved_model_looks_the_same_from_moved_cameras(rest, rng):
    """Positions, rotations, sizes and harmonics of every degree follow."""
    pytest.importorskip("torch", reason="rendering needs PyTorch")
    from splatseed.camera import Camera
    from splatseed.photos.view import NO_PIXELS, View
    from splatseed.splat.rendering import ModelRenderer
    from splatseed.splat.training_frame import TrainingFrame

    count = 150
    arrays = {
        "means": rng.uniform([-1, -1, 3], [1, 1, 5], (count, 3)),
        "scales": np.log(rng.uniform(0.02, 0.3, (count, 3))),
        "quats": rng.normal(size=(count, 4)),
        "opacities": rng.normal(size=count),
        "sh0": rng.normal(size=(count, 1, 3)),
        "shN": 0.4 * rng.normal(size=(count, rest, 3)),
    }
    model = Gaussians(**{name: each.astype(np.float32) for name, each in arrays.items()})
    similarity = parse_similarity(" ".join(map(str, MOVE.ravel())))
    view = View(
        "a", NO_PIXELS, Camera(np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48, np.eye(4))
    )
    near = TrainingFrame(np.zeros(3), 1.0, near=0.01)
    far = TrainingFrame(np.zeros(3), 1.0, near=0.025)
    image = ModelRenderer(model, near).image(view)
    moved = ModelRenderer(transform_gaussians(model, similarity), far).image(
        view_in_model_frame(similarity, view)
    )
    assert float(image.std()) > 0.1
    assert float((image - moved).abs().max()) < 1e-4
    if rest:  # and does not if the harmonics stay
        still = transform_gaussians(model, Similarity(2.5, TURN, MOVE[:3, 3]))
        object.__setattr__(still, "shN", model.shN)
        other = ModelRenderer(still, far).image(view_in_model_frame(similarity, view))
        assert float((image - other).abs().max()) > 0.1
