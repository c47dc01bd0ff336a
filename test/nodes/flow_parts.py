"""Nodes that do nothing but speak in sessions, for the tests of imu_fusion/nodes/flow."""

from std_msgs.msg import Int64

from imu_fusion.nodes.flow import END, Flow


def value(cdr):
    return int.from_bytes(cdr[4:12], "little", signed=True)


class Part:
    """A node with a Flow, whose turns the graph of the test makes."""

    def __init__(self, graph, name, **options):
        self.node = graph.node(name)
        self.flow = Flow(self.node, **options)
        self.node.work, self.node.finished = self.work, False

    def work(self):
        return self.flow.pause(0.05)


class Sender(Part):
    """Publishes the integers 0..count-1 as fast as it may, in sessions."""

    def __init__(self, graph, name="sender", topic="/numbers", **options):
        super().__init__(graph, name, listens=False, **options)
        self.source = self.flow.source
        self.out = self.flow.output(Int64, topic)
        self.todo, self.event = [], None

    def session(self, count, event=END):
        self.todo, self.event = list(range(count))[::-1], event
        self.source.begin()

    def work(self):
        self.flow.send()
        while self.todo and self.source.ready():
            self.out.publish(Int64(data=self.todo.pop()))
        if not self.todo and self.event and self.source.ready():
            self.source.end(self.event)
            self.event = None
        return super().work()


class Receiver(Part):
    """Takes integers, while ``takes``."""

    def __init__(self, graph, name="receiver", topic="/numbers", qos=None, **options):
        super().__init__(graph, name, **options)
        self.values, self.ended, self.over, self.takes = [], [], [], True
        self.flow.sink.gate.can_execute = lambda entity: self.takes
        self.input = self.flow.input(Int64, topic, qos)

    def work(self):
        if self.takes:
            turn = self.flow.take()
            for block in turn.blocks.values():
                self.values += [value(cdr) for cdr, _ in block]
            self.over += turn.over
            self.ended += [session.event for session in turn.over]
            self.flow.finish(turn)
        return super().work()


class Doubler(Part):
    """A processing node: every number gives two."""

    def __init__(self, graph, name="doubler", inputs=("/numbers",), output="/doubled"):
        super().__init__(graph, name, relays=True)
        self.out = self.flow.output(Int64, output)
        for topic in inputs:
            self.flow.input(Int64, topic)
        self.begun, self.ended, self.finishes, self.most = [], [], 0, 0

    def work(self):
        if self.flow.send():
            turn = self.flow.take()
            if turn.begun:
                self.begun.append(turn.begun)
            for block in turn.blocks.values():
                for cdr, _ in block:
                    self.out.publish(Int64(data=value(cdr)))
                    self.out.publish(Int64(data=value(cdr)))
            self.ended += turn.ended
            if turn.event:
                self.finishes += 1
                self.out.publish(Int64(data=999_999))
            self.flow.finish(turn)
        self.most = max(self.most, len(self.out.waiting))
        return super().work()


def twice(count):
    return [i for i in range(count) for _ in range(2)] + [999_999]
