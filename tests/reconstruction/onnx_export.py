"""Export of a head to ONNX, checked by running what was written."""

from __future__ import annotations

import warnings

import onnxruntime
import torch


def check_onnx(head, image, another=None) -> list[str]:
    """Export with one image, run with ``another``, compare with PyTorch to 1e-4. Return the output names.

    ``image`` may be a tuple of all inputs. The batch is dynamic where ``another`` is given, and fixed otherwise:
    symbolic shapes take the exporter twice as long.
    """
    head, given = head.eval(), image if isinstance(image, tuple) else (image,)
    shapes = None if another is None else {"image": {0: torch.export.Dim("batch")}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # raised by PyTorch's exporter about itself
        program = torch.onnx.export(head, given, dynamo=True, dynamic_shapes=shapes, verbose=False)
    others = (torch.rand_like(given[0]) if another is None else another, *given[1:])
    session = onnxruntime.InferenceSession(program.model_proto.SerializeToString())
    with torch.no_grad():
        expected = head(*others)
    expected = (expected,) if isinstance(expected, torch.Tensor) else expected
    names = [each.name for each in session.get_inputs()]
    found = session.run(None, {name: value.numpy() for name, value in zip(names, others, strict=True)})
    for value, reference in zip(found, expected, strict=True):
        torch.testing.assert_close(torch.from_numpy(value), reference, atol=1e-4, rtol=0.0)
        assert reference.std() > 1e-3  # there is something to compare
    return [output.name for output in session.get_outputs()]
