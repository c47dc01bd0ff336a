"""Sink and source of a processing node: :class:`Relay`."""

from imu_fusion.nodes.flow.protocol import END, NEXT, WINDOW
from imu_fusion.nodes.flow.sink import FlowSink
from imu_fusion.nodes.flow.source import FlowSource


class Relay:
    """Sink and source of a processing node, tied together.

    ``processor`` (usually the node) has four methods:

    ``reset(topics)``: a session with these input topics begins.
    ``step()``: process one sample that may be processed; False if there is none.
    ``topic_ended(topic)``: nothing more comes on this input.
    ``finish()``: all inputs have ended and all samples are processed; publish the rest.

    Samples wait in the processor while the outputs are full; outputs made by ``finish``
    may exceed the window: they wait in the outboxes.
    """

    def __init__(self, node, processor, *, wait_for=(), window=WINDOW):
        self._processor = processor
        self._finishing = None
        self.source = FlowSource(node, wait_for=wait_for, window=window, on_ready=self.pump)
        self.sink = FlowSink(
            node, on_begin=self._begin, on_company=self._join, on_topic_end=processor.topic_ended,
            on_end=self._end, hold=lambda: not self.source.ready(), confirm=False,
            ack_every=max(1, window // 4))

    def publisher(self, msg_type, topic, qos=None):
        """A :class:`FlowPublisher` of this node."""
        return self.source.publisher(msg_type, topic, qos)

    def subscribe(self, msg_type, topic, callback, qos=None):
        """``callback(cdr, info)`` stores a sample; the relay then calls ``processor.step``."""
        def on_data(cdr, info):
            callback(cdr, info)
            self.pump()
        return self.sink.subscribe(msg_type, topic, on_data, qos)

    def pump(self):
        """Process what may be processed, as far as the outputs take it."""
        while self.source.ready() and self._processor.step():
            pass
        if self._finishing and self.source.ready():
            event, self._finishing = self._finishing, None
            self._processor.finish()
            self.source.end(event)
            self.sink.done()
        self.sink.release()

    def close(self):
        """The node stops: whoever listens is told that nothing more comes."""
        self.source.end()

    def _begin(self, session):
        feeding = self.sink.feeding()
        if session not in feeding:
            return
        if len(feeding) == 1:
            self.source.begin(session.company)
        else:
            self.source.expect(session.company)
        self._processor.reset(sorted({topic for s in feeding for topic in s.topics
                                  if topic in self.sink.inboxes}))

    def _join(self, session):
        if session in self.sink.feeding():
            self.source.expect(session.company)

    def _end(self, session):
        if not self.sink.feeding():
            self._finishing = NEXT if session.event == NEXT else END
            self.pump()
