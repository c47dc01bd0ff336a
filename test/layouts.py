"""All layouts of messages, by type."""

from imu_fusion.messages import layouts

LAYOUTS = {layout.msgtype: layout for layout in vars(layouts).values()
           if isinstance(layout, layouts.Layout)}
