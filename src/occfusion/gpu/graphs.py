"""Functions of tensors as CUDA graphs: recorded once, then started as a whole, forwards and backwards.

A step of a training starts hundreds of kernels that take microseconds each, and the device waits for the host, which
needs ten times as long to start one. A graph is started like one kernel. It holds the very kernels of the function, in
their order: nothing is computed in another way. Whether that is so is looked at while it is used: what a recording
gives is held against the function, and a function whose recording differs is called from then on.
"""

from __future__ import annotations

import logging
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

logger = logging.getLogger(__name__)

Function = Callable[..., tuple[Tensor, ...]]
Gradients = tuple[Tensor | None, ...]

CALLS_BEFORE = 2
"""With tensors of the same shapes, before they are taken for usual: a recording costs some calls."""
WARM_UPS = 2
"""Runs beside the graph in which libraries make ready what may not be made during a recording."""
MOST_KEPT = 12
"""Recordings of one function, each with the memory of all that it computes."""
CHECKED_FIRST, CHECKED_EVERY = 3, 64
"""Calls of a recording that are held against the function: so many at first, then each so manieth."""
ROUNDING = 1e-3
"""Relative: sums of many numbers are formed in another order each time."""


_ALL: WeakSet[GraphedFunction] = WeakSet()
_is_on = False


def record(is_on: bool) -> None:
    """Lets functions be recorded from now on, or no longer.

    In the end all recordings are dropped, with their memory: the shapes of a training do not return.
    """
    global _is_on
    _is_on = is_on
    if not is_on:
        for function in _ALL:
            function.forget()


def is_recording() -> bool:
    """Returns whether functions may be recorded: whether what only a recording needs is worth preparing."""
    return _is_on


class GraphedFunction:
    """A function of CUDA tensors that is recorded where it is called again with tensors of the same shapes.

    On other devices, or where it cannot be recorded or is not to be (`record`), the function itself is called. Results
    of a recording are overwritten by the next call; while gradients of a call are still to come, another call runs
    the function itself.

    Args:
        function: of tensors that are given by position; gives a tuple of tensors. It may not ask the device for
            values (no `item`, no shape that depends on them) nor for random numbers, and reads no other tensor that
            could be put elsewhere: a graph knows places in memory.
    """

    def __init__(self, function: Function) -> None:
        self._function = function
        self._calls: OrderedDict[Hashable, int] = OrderedDict()
        self._recordings: OrderedDict[Hashable, _Recording] = OrderedDict()
        self._is_refused = False
        _ALL.add(self)

    def __call__(self, *inputs: Tensor, key: Hashable = None) -> tuple[Tensor, ...]:
        """Returns the function of the inputs, differentiable in those that require a gradient.

        Args:
            inputs: all on one CUDA device, or the function is just called. Parameters are read where they are,
                others are copied.
            key: of all that the function depends on besides: calls with another key are recorded by themselves.
        """
        if not _is_on or self._is_refused or not _may_be_recorded(inputs):
            return self._function(*inputs)
        whole = (key, torch.is_grad_enabled(), tuple(map(_kind, inputs)))
        recording = self._recordings.get(whole)
        if recording is None:
            recording = self._record(whole, inputs)
        elif recording.is_wrong:
            self._refuse("its recording gives something else")
            recording = None
        elif recording.is_busy:
            recording = None
        else:
            self._recordings.move_to_end(whole)
        return self._function(*inputs) if recording is None else recording(inputs)

    def forget(self) -> None:
        """Drops all recordings, and their memory."""
        self._calls.clear()
        self._recordings.clear()

    def _record(self, key: Hashable, inputs: tuple[Tensor, ...]) -> _Recording | None:
        """Returns a recording of these inputs once they are known as usual ones."""
        count = self._calls[key] = self._calls.pop(key, 0) + 1
        while len(self._calls) > 4 * MOST_KEPT:
            self._calls.popitem(last=False)
        if count <= CALLS_BEFORE:
            return None
        try:
            recording = _Recording(self._function, inputs)
        except RuntimeError as error:  # whatever the driver does not take: the function does without
            self._refuse(str(error).splitlines()[0])
            return None
        self._recordings[key] = recording
        while len(self._recordings) > MOST_KEPT:
            self._recordings.popitem(last=False)
        return recording

    def _refuse(self, reason: str) -> None:
        """Calls the function itself from now on, and says so."""
        self._is_refused = True
        self.forget()
        name = getattr(self._function, "__qualname__", repr(self._function))
        logger.warning("%s is not started as a CUDA graph: %s", name, reason)


def _may_be_recorded(inputs: tuple[Tensor, ...]) -> bool:
    # tensors of inference mode could not be used in a training afterwards
    return all(tensor.is_cuda for tensor in inputs) and not torch.is_inference_mode_enabled()


def _kind(tensor: Tensor) -> Hashable:
    place = tensor.data_ptr() if isinstance(tensor, nn.Parameter) else None
    return tuple(tensor.shape), tensor.dtype, tensor.requires_grad, place


class _Recording:
    """The graph of a function at tensors of some shapes, and that of its gradient."""

    def __init__(self, function: Function, inputs: tuple[Tensor, ...]) -> None:
        # of a parameter a leaf of its own, or its gradients would be summed on the stream of the recording for good
        own = (t.detach() if isinstance(t, nn.Parameter) else t.detach().clone() for t in inputs)
        self._inputs = [t.requires_grad_(given.requires_grad) for t, given in zip(own, inputs, strict=True)]
        self._function = function
        self._call: weakref.ref[_Call] | None = None
        self._count = 0
        self.is_wrong = False
        """Whether a call gave something else than the function."""
        stream, usual = _stream_of_recordings(self._inputs[0].device), torch.cuda.current_stream()
        stream.wait_stream(usual)
        with torch.cuda.stream(stream):
            for _ in range(WARM_UPS):
                outputs = function(*self._inputs)
                _gradients(outputs, self._inputs, [torch.zeros_like(o) for o in outputs])
            del outputs
            stream.synchronize()
            self._forward = torch.cuda.CUDAGraph()
            outputs = _captured(self._forward, None, lambda: function(*self._inputs))
            self._has_gradient = [output.requires_grad for output in outputs]
            self._given = [torch.zeros_like(output) for output in outputs]
            self._backward: torch.cuda.CUDAGraph | None = None
            self._gradients: Gradients = ()
            if self.is_differentiable:
                stream.synchronize()
                self._backward, pool = torch.cuda.CUDAGraph(), self._forward.pool()
                self._gradients = _captured(
                    self._backward, pool, lambda: _gradients(outputs, self._inputs, self._given)
                )
            self._outputs = [output.detach() for output in outputs]
        usual.wait_stream(stream)

    @property
    def is_differentiable(self) -> bool:
        """Whether there is a gradient to ask for."""
        return any(self._has_gradient)

    @property
    def is_busy(self) -> bool:
        """Whether gradients of a call are still to come, which need what that call has computed."""
        call = None if self._call is None else self._call()
        return call is not None and not call.is_over

    def __call__(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Returns the function of the inputs; every so often it is called, too, and what it gives is returned."""
        self._count += 1
        is_checked = self._count <= CHECKED_FIRST or self._count % CHECKED_EVERY == 0
        if self.is_differentiable:
            return _Replay.apply(self, is_checked, *inputs)
        outputs = self._replay(inputs)
        return self._checked(outputs, self._function(*inputs)) if is_checked else outputs

    def begin(self) -> _Call:
        """Returns the mark of a call, alive as long as its gradients can be asked for."""
        call = _Call()
        self._call = weakref.ref(call)
        return call

    def _replay(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        for own, given in zip(self._inputs, inputs, strict=True):
            if own.data_ptr() != given.data_ptr():
                own.detach().copy_(given.detach())
        self._forward.replay()
        return tuple(output.detach() for output in self._outputs)

    def _replay_gradients(self, given: Gradients) -> Gradients:
        """Returns what `_gradients` does."""
        assert self._backward is not None
        for own, has_gradient, gradient in zip(self._given, self._has_gradient, given, strict=True):
            if gradient is not None:
                own.copy_(gradient)
            elif has_gradient:
                own.zero_()
        self._backward.replay()
        return tuple(None if gradient is None else gradient.detach() for gradient in self._gradients)

    def _checked(self, found: Gradients, wanted: Gradients) -> Any:
        """Returns what the function gives; remembers whether what was found differs from it."""
        self.is_wrong = self.is_wrong or not all(map(_agree, found, wanted))
        return wanted

    def _plain_gradients(self, inputs: tuple[Tensor, ...], given: Gradients) -> Gradients:
        """Returns the gradients of all inputs by the function itself."""
        leaves = [tensor.detach().requires_grad_(tensor.requires_grad) for tensor in inputs]
        with torch.enable_grad():
            outputs = self._function(*leaves)
        return _gradients(outputs, leaves, given)


def _gradients(
    outputs: Sequence[Tensor], inputs: Sequence[Tensor], given: Sequence[Tensor | None]
) -> Gradients:
    """Returns the gradients of all inputs; None for those that require none, or do not matter."""
    pairs = [(o, g) for o, g in zip(outputs, given, strict=True) if o.requires_grad and g is not None]
    wanted = [tensor for tensor in inputs if tensor.requires_grad]
    if not wanted or not pairs:
        return (None,) * len(inputs)
    found = iter(torch.autograd.grad([o for o, _ in pairs], wanted, [g for _, g in pairs], allow_unused=True))
    return tuple(next(found) if tensor.requires_grad else None for tensor in inputs)


class _Call:
    """One call of a recording; over when its gradients were asked for, or can no longer be."""

    def __init__(self) -> None:
        self.is_over = False


class _Replay(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, recording: _Recording, is_checked: bool, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        outputs = recording._replay(inputs)
        if is_checked:
            with torch.no_grad():
                outputs = recording._checked(outputs, recording._function(*inputs))
        ctx.recording, ctx.call = recording, recording.begin()
        ctx.inputs = inputs if is_checked else None
        ctx.mark_non_differentiable(
            *(o for o, has_gradient in zip(outputs, recording._has_gradient, strict=True) if not has_gradient)
        )
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        recording: _Recording = ctx.recording
        found = recording._replay_gradients(given)
        if ctx.inputs is not None:
            found = recording._checked(found, recording._plain_gradients(ctx.inputs, given))
        ctx.call.is_over = True
        return (None, None, *found)


def _agree(found: Tensor | None, wanted: Tensor | None) -> bool:
    """Returns whether two results are the same but for rounding; none is as good as zero."""
    if found is None or wanted is None:
        other = wanted if found is None else found
        return other is None or not bool(other.any())
    if not found.is_floating_point():
        return torch.equal(found, wanted)
    found, wanted = found.double(), wanted.double()
    # where the function itself gives what is not finite, whoever looks at losses says so
    return bool((found - wanted).norm() <= ROUNDING * wanted.norm()) or not bool(wanted.isfinite().all())


@lru_cache(maxsize=16)
def _stream_of_recordings(device: torch.device) -> torch.cuda.Stream:
    """Returns the one stream that all is recorded on: libraries keep memory for each that they see."""
    return torch.cuda.Stream(device)


def _captured(graph: torch.cuda.CUDAGraph, pool: Any, work: Callable[[], Any]) -> Any:
    """Records what `work` starts on the current stream; other threads may go on with theirs."""
    # memory that cuBLAS works in is to belong to the graph: what is kept elsewhere is freed when a training ends
    _forget_workspaces()
    graph.capture_begin(pool=pool, capture_error_mode="thread_local")
    try:
        return work()
    finally:
        graph.capture_end()
        _forget_workspaces()


def _forget_workspaces() -> None:
    """As `torch._inductor` and Lightning do, for want of a public name.

    Where a release of torch has it no longer, recordings are dropped before that happens all the same.
    """
    clear = getattr(torch._C, "_cuda_clearCublasWorkspaces", None)
    if clear is not None:
        clear()
