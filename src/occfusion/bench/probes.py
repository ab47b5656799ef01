"""Where the time of a running step goes: each part's own share, forward and backward, without what it calls.

A probe is put around functions of live objects. What one probed function spends inside another belongs to the other,
so parts add up to the whole. The backward pass has no functions to put anything around; but autograd numbers its nodes
as they are made, and each node's time is given to the part that made it.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

FORWARD, BACKWARD = "forward", "backward"
GRADIENTS = "autograd: gradients of parameters"
"""Part of the nodes that hold the leaves' gradients; they are not made by a part."""
ENGINE = "autograd: sums of terms"
"""Part of the nodes that no part made, and of what the engine does before the first."""


@dataclass
class Spent:
    """Time of a part, seconds.

    Attributes:
        cpu: of the processor, all threads added up.
        wall: by the clock on the wall.
    """

    cpu: float = 0.0
    wall: float = 0.0


@dataclass
class Probes:
    """Gives the time between two moments of one thread to the part that was innermost then.

    Attributes:
        rest: part of what no probe is around.
        active: whether anything is counted; off, a probe is one more call.
        spent: by part and direction.
    """

    rest: str
    active: bool = False
    spent: dict[tuple[str, str], Spent] = field(default_factory=lambda: defaultdict(Spent))
    _stack: list[str] = field(default_factory=list)
    _direction: str = FORWARD
    _made: list[tuple[int, int, str]] = field(default_factory=list)
    _cpu: float = 0.0
    _wall: float = 0.0
    _aside: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    _undo: list[tuple[Any, str, Any, bool]] = field(default_factory=list)

    # -- counting ---------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begins to count, outside of all parts."""
        self.active, self._stack, self._direction = True, [self.rest], FORWARD
        self._made.clear()
        self._cpu, self._wall = self._now()

    def stop(self) -> None:
        """Stops counting; what was counted stays."""
        self._give()
        self.active = False

    def _now(self) -> tuple[float, float]:
        # what a thread of its own spent meanwhile is counted there
        return time.process_time() - sum(self._aside.values()), time.perf_counter()

    def _give(self) -> None:
        cpu, wall = self._now()
        spent = self.spent[self._stack[-1], self._direction]
        spent.cpu += cpu - self._cpu
        spent.wall += wall - self._wall
        self._cpu, self._wall = cpu, wall

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Counts what is inside as that part's."""
        self._give()
        self._stack.append(name)
        first = _next_node()
        try:
            yield
        finally:
            self._made.append((first, _next_node(), name))
            self._give()
            self._stack.pop()

    @contextmanager
    def uncounted(self) -> Iterator[None]:
        """Leaves out what is inside: the probes' own work."""
        self._give()
        try:
            yield
        finally:
            self._cpu, self._wall = self._now()

    # -- probes -----------------------------------------------------------------------------------------------

    def around(self, owner: Any, attribute: str, name: str, *, not_in: str | None = None) -> None:
        """Puts a probe around a function of an object or a module.

        Args:
            owner: the object; where it has no such attribute of its own, it gets one until `remove`.
            attribute: name of the function.
            name: of the part.
            not_in: inside this part the call counts as that part's.
        """
        original = getattr(owner, attribute)

        def probed(*arguments: Any, **named: Any) -> Any:
            if not self.active or not_in in self._stack:
                return original(*arguments, **named)
            with self.part(name):
                return original(*arguments, **named)

        self.replace(owner, attribute, probed)

    def beside(self, owner: Any, attribute: str, name: str) -> None:
        """Puts a probe around a function that is called in a thread of its own; its processor time is that thread's."""
        original = getattr(owner, attribute)

        def probed(*arguments: Any, **named: Any) -> Any:
            if not self.active or threading.current_thread() is threading.main_thread():
                return original(*arguments, **named)
            before = time.thread_time()
            try:
                return original(*arguments, **named)
            finally:
                if self.active:
                    self._aside[name] += time.thread_time() - before

        self.replace(owner, attribute, probed)

    def around_closure(self, owner: Any, attribute: str, name: str) -> None:
        """Puts a probe around an optimiser's step; the closure that it calls first, if any, is not the step's."""
        original = getattr(owner, attribute)

        def probed(closure: Callable[[], Any] | None = None, **named: Any) -> Any:
            if not self.active:
                return original(closure, **named)

            def outside() -> Any:
                with self.part(self.rest):
                    return closure()  # type: ignore[misc]

            with self.part(name):
                return original(None if closure is None else outside, **named)

        self.replace(owner, attribute, probed)

    def around_backward(self, owner: Any, attribute: str) -> None:
        """Puts a probe around a function whose first argument is the tensor that the backward pass begins at."""
        original = getattr(owner, attribute)

        def probed(loss: Tensor, *arguments: Any, **named: Any) -> Any:
            if not self.active:
                return original(loss, *arguments, **named)
            with self.uncounted():
                self._watch_nodes(loss)
            with self.part(ENGINE):
                self._give()
                self._direction = BACKWARD
                try:
                    return original(loss, *arguments, **named)
                finally:
                    self._give()
                    self._direction = FORWARD
                    self._stack[-1] = ENGINE

        self.replace(owner, attribute, probed)

    def _watch_nodes(self, loss: Tensor) -> None:
        """Makes every node of a graph say which part it belongs to when its turn comes."""
        made = sorted(self._made, key=lambda interval: interval[1] - interval[0])  # innermost first

        def part_of(number: int) -> str:
            return next((name for first, end, name in made if first <= number < end), ENGINE)

        def turn_to(name: str) -> Callable[..., None]:
            def turn(*_: Any) -> None:
                if self._stack[-1] != name:
                    self._give()
                    self._stack[-1] = name

            return turn

        seen, waiting = set(), [loss.grad_fn]
        turns: dict[str, Callable[..., None]] = {}
        while waiting:
            node = waiting.pop()
            if node is None or node in seen:
                continue
            seen.add(node)
            waiting += [next_node for next_node, _ in node.next_functions]
            is_leaf = not node.next_functions
            name = GRADIENTS if is_leaf else part_of(node._sequence_nr())
            node.register_prehook(turns.setdefault(name, turn_to(name)))
        self._made.clear()

    def replace(self, owner: Any, attribute: str, function: Callable[..., Any]) -> None:
        """Puts a function in place of another until `remove`."""
        own = vars(owner)
        self._undo.append((owner, attribute, own.get(attribute), attribute in own))
        setattr(owner, attribute, function)

    def remove(self) -> None:
        """Takes all probes away."""
        while self._undo:
            owner, attribute, before, was_own = self._undo.pop()
            if was_own:
                setattr(owner, attribute, before)
            else:
                delattr(owner, attribute)

    def totals(self) -> dict[tuple[str, str], Spent]:
        """Returns what was counted, threads of their own among it."""
        aside = {(name, FORWARD): Spent(seconds, 0.0) for name, seconds in self._aside.items()}
        return {**self.spent, **aside}


def _next_node() -> int:
    """Returns the number of the node that autograd makes next in this thread."""
    number: int = torch._C._autograd._get_sequence_nr()
    return number
