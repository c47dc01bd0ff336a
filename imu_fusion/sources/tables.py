"""Tables that need no description: their header names sensors, axes and units."""

from imu_fusion.errors import SampleError
from imu_fusion.sources.description import Description
from imu_fusion.sources.sketch import sketch
from imu_fusion.sources.source import Block, WholeSource
from imu_fusion.sources.table import TableSource


class Tables(WholeSource):
    """A table, or those of a folder that tell what they hold; others are named and left out."""

    def finish(self) -> list[Block]:
        blocks: list[Block] = []
        for part, data in self.parts.items():
            try:
                found = sketch(bytes(data), part)
            except SampleError:
                continue
            if not found.is_sure:
                self.remark(f"{part} is left out: its header leaves open "
                            + (", ".join(found.doubts) or "what it holds"))
                continue
            table = TableSource(Description.from_mapping(found.content, part))
            more = table.feed(bytes(data), part) + table.finish()
            self.lost += table.lost
            for text in table.remarks:
                self.remark(text)
            both = {b.topic for b in blocks} & {b.topic for b in more}
            if both:
                raise SampleError(f"{part}: holds {', '.join(sorted(both))}, as another file of "
                                  "the folder does; name the file that is meant")
            blocks += more
            if found.content["time"].get("start"):
                self.remark("times count from some start: stamps begin at an arbitrary instant")
            if "accelerometer" in found.remarks:
                self.remark(f"accelerometer: {found.remarks['accelerometer']}")
        return blocks
