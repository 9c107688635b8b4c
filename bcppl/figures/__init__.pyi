from bcppl.figures.images import depth_residual as depth_residual, outlines_on_depth as outlines_on_depth
from bcppl.figures.in_space import action_in_3d as action_in_3d, belief_in_3d as belief_in_3d
from bcppl.figures.marginals import marginals as marginals, shared_error_bars as shared_error_bars
from bcppl.figures.of_measurements import pictures as pictures
from bcppl.figures.over_time import (
    add_over_time as add_over_time,
    column_over_time as column_over_time,
    spread_over_time as spread_over_time,
)
from bcppl.figures.touches import (
    gains_on_part as gains_on_part,
    gap_over_time as gap_over_time,
    touches_on_part as touches_on_part,
    wrench_over_time as wrench_over_time,
)
