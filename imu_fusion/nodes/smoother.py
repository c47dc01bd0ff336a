"""The smoother as a node: collects, smooths in a child process when asked, publishes."""

import itertools
import multiprocessing
import pickle
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy
from rclpy.task import Future
from std_srvs.srv import Trigger

from imu_fusion.errors import EstimationError, ImuFusionError, TopicError
from imu_fusion.kernels import announced_compiling
from imu_fusion.nodes.base import IDLE
from imu_fusion.nodes.estimator import EstimatorNode
from imu_fusion.nodes.flow import END, NAP_PATIENT, reliable_qos
from imu_fusion.signals import end_after
from imu_fusion.streams.smoother import INPUTS, SmootherStream, frame_of, lacking, smooth
from imu_fusion.streams.smoother_messages import ONCE, Outcome, messages, outputs_of
from imu_fusion.streams.smoother_params import SmootherNodeParams, SmoothingParams
from imu_fusion.streams.stream import EstimatorNodeParams, one_by_one
from imu_fusion.surfaces.file import load_surface

_POLL = 0.002  # s between callbacks while a child smooths, see work()
_INPUT, _SAMPLES, _OUTCOME = "input", "samples.npy", "outcome"  # files of the child
_SLICE = 200  # messages published between callbacks


def _latched(count):
    return reliable_qos(count, DurabilityPolicy.TRANSIENT_LOCAL)


def _smooth_in_child(folder):
    """Entry point of the child process: its input lies in a folder, and there it leaves samples
    and their Outcome, or the reason why there are none."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_after(parent.join)
    folder = Path(folder)
    outcome: Outcome | str
    try:
        params, logs = pickle.loads((folder / _INPUT).read_bytes())
        with announced_compiling(lambda text: print(f"smoother: {text}", file=sys.stderr)):
            result = smooth(params, logs)
        np.save(folder / _SAMPLES, result.samples)
        outcome = Outcome.of(result, frame_of(logs), params.gnss.lever_arm)
    except ImuFusionError as error:
        outcome = str(error)
    except KeyboardInterrupt:
        return  # the parent is ending, too
    except Exception as error:
        traceback.print_exc()
        outcome = f"smoothing failed: {type(error).__name__}: {error}"
    (folder / _OUTCOME).write_bytes(pickle.dumps(outcome))


class _Child:
    """A child process that smooths."""

    def __init__(self, params, logs):
        self._folder = tempfile.TemporaryDirectory(prefix="imu_fusion_")
        # Files: a child that is killed before it has read its arguments would stall its parent.
        with open(Path(self._folder.name) / _INPUT, "wb") as stream:
            pickle.dump((params, logs), stream)
        self._process = multiprocessing.get_context("spawn").Process(
            target=_smooth_in_child, daemon=True, args=(self._folder.name,))
        self._process.start()

    def is_done(self):
        """Whether it has ended."""
        return not self._process.is_alive()

    def result(self):
        """(samples, Outcome), or the reason why there are none."""
        folder = Path(self._folder.name)
        if self._process.exitcode or not (folder / _OUTCOME).exists():
            return ("the smoothing process ended without an answer (exit code "
                    f"{self._process.exitcode}): out of memory?")
        outcome = pickle.loads((folder / _OUTCOME).read_bytes())
        if isinstance(outcome, str):
            return outcome
        # Mapped: read piece by piece, as they are published.
        return np.load(folder / _SAMPLES, mmap_mode="r"), outcome

    def close(self):
        """End the process: it has nothing more to say, or nobody listens any more."""
        self._process.kill()
        self._process.join()
        self._folder.cleanup()


class SmootherNode(EstimatorNode):
    """Trajectory from imu/data_raw, imu/mag, fix and fix_velocity, when smoother/smooth is called.

    Services (std_srvs/Trigger): ~/smooth, ~/clear.
    """

    NAME = "smoother"
    TASK = "collection"
    PARAMETERS = (EstimatorNodeParams, SmootherNodeParams, SmoothingParams)

    def _set_up(self):
        super()._set_up()
        p, smoothing_params = self.params(SmootherNodeParams), self.params(SmoothingParams)
        if smoothing_params.surface.file:
            load_surface(smoothing_params.surface.file)
        self._at_end = p.smooth_at_end
        stream = SmootherStream(smoothing_params, p.memory_limit * 1e6, self.get_logger().warning)
        self.attach(stream, outputs_of(smoothing_params), _latched(1), relays=False,
                    nap=NAP_PATIENT, on_begin=self._on_begin)
        self._source = self._flow.source
        self._child: Any = None
        self._answer: Any = None  # a Future: (whether it was smoothed, what is said of it)
        self._result = self._messages = None
        # Reentrant: a second call is answered while the first one still waits.
        self.create_service(Trigger, "~/smooth", self._on_smooth,
                            callback_group=ReentrantCallbackGroup())
        self.offer("clear", self._clear)

    def work(self) -> float:
        """One turn: take all that waits, smooth, publish. See :meth:`Node.work`."""
        self._flow.send()
        turn = self._flow.take()
        self.publish(self.through(turn))
        self._flow.finish(turn)
        if self._at_end and turn.event == END:
            self._insist(self._replay_broke_off(turn.over) or self._start())
        if self._child is not None:
            # The executor polls the coroutine of a waiting service without rest.
            time.sleep(_POLL)
            if self._child.is_done():
                self._conclude()
            return 0.0
        return 0.0 if self._publish() else self._flow.pause(IDLE)

    def stop(self) -> None:
        """At once: what is not smoothed will not be."""
        self.finished = True

    def close(self) -> None:
        """End the child, if there is one."""
        super().close()
        if self._child is not None:
            self._child.close()

    def _on_begin(self, session):
        played = {self._names.get(topic) for topic in session.said.topics} & INPUTS.keys()
        missing = lacking(self._stream.params, played)
        if played and missing and self._at_end:
            raise TopicError(f"{session.source} plays no {' and no '.join(missing)}: there "
                             "will be nothing to smooth")

    @staticmethod
    def _replay_broke_off(sessions):
        broken = [session.source for session in sessions if session.broken]
        return f"the replay of {', '.join(broken)} broke off" if broken else ""

    def _insist(self, refusal):
        if refusal:
            raise EstimationError(f"not smoothed: {refusal}")

    async def _on_smooth(self, request, response):
        response.message = self._start()
        if not response.message:
            response.success, response.message = await self._answer
        return response

    def _start(self):
        """Have smoothed what was collected; returns why not, if not."""
        if self._child is not None:
            return "refused: smoothing is already running"
        if self._result is not None or self._messages is not None:
            return "refused: the last result is still being published"
        try:
            logs = self._stream.logs()
        except ImuFusionError as error:
            return str(error)
        counts = ", ".join(f"{len(log)} {topic}" for topic, log in logs.items())
        self.get_logger().info(f"smoothing {counts}")
        self._answer = Future()
        self._child = _Child(self.params(SmoothingParams), logs)
        return ""

    def _conclude(self):
        """The child has said all: answer."""
        child, self._child = self._child, None
        result = child.result()
        child.close()
        if isinstance(result, str):
            self._answer.set_result((False, result))
            if self._at_end:
                self._insist(result)
            self.get_logger().info(result)
            return
        _, outcome = self._result = result
        message = "; ".join([outcome.summary, *outcome.remarks, *self._left_out()])
        self.get_logger().info(message)
        self._answer.set_result((True, message))

    def _publish(self):
        """Publish some of a result, as the subscribers take it; whether more could follow now.

        Publishers are made anew: what late subscribers get is all of this result and nothing
        of those before.
        """
        if self._result is not None:
            if not self._source.drained():
                return False
            samples, outcome = self._result
            self._result = None
            for topic, output in self._outputs.items():
                output.renew(_latched(1 if topic in ONCE else len(samples)))
            self._source.begin()
            made = messages(samples, outcome, self.params(SmoothingParams))
            self._messages = itertools.chain.from_iterable(map(one_by_one, made))
        if self._messages is None:
            return False
        for _ in range(_SLICE):
            if not self._source.ready():
                return False
            message = next(self._messages, None)
            if message is None:
                self._messages = None
                self._source.end()
                return False
            topic, _, cdr = message
            self._outputs[topic].publish(cdr)
        return True

    def _clear(self):
        self._stream.reset()
        return "the collection is empty"

    def _left_out(self):
        """Texts on the samples of the collection that were not used."""
        return [f"{topic}: {count} samples left out: {why}" for topic in self._stream.inputs
                for why, count in self._stream.refused(topic).items()]

    def _status(self):
        stream = self._stream
        values: dict[str, float] = {f"{topic} collected": n for topic, n in stream.counts().items()}
        left_out = {f"{topic} {why}": n for topic in stream.inputs
                    for why, n in stream.refused(topic).items()}
        values |= left_out
        values |= {"megabytes": round(stream.bytes / 1e6, 1), "dropped": stream.dropped}
        if stream.dropped:
            return DiagnosticStatus.ERROR, "memory_limit reached, samples are dropped", values
        if self._child is not None:
            return DiagnosticStatus.OK, "smoothing", values
        if self._result is not None or self._messages is not None:
            return DiagnosticStatus.OK, "publishing", values
        if left_out:
            return DiagnosticStatus.WARN, "collecting; samples were left out", values
        return DiagnosticStatus.OK, "collecting", values
