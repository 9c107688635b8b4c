from bcppl.inference.planning.candidate_layout import plan_candidates as plan_candidates
from bcppl.inference.planning.constraints import (
    Candidates as Candidates,
    Constraint as Constraint,
    feasible as feasible,
    per_candidate as per_candidate,
)
from bcppl.inference.planning.insertion import (
    InsertionParameters as InsertionParameters,
    insertion_plan as insertion_plan,
)
from bcppl.inference.planning.metrology import three_two_one as three_two_one
from bcppl.inference.planning.metrology_parameters import (
    ROCKED as ROCKED,
    MetrologyParameters as MetrologyParameters,
)
from bcppl.inference.planning.motion_constraints import (
    above_table as above_table,
    approach_within as approach_within,
    collision_free as collision_free,
    contact_at_mid_stroke as contact_at_mid_stroke,
    duration_at_most as duration_at_most,
    force_at_most as force_at_most,
    not_from_below as not_from_below,
    within_reach as within_reach,
)
from bcppl.inference.planning.success import (
    SuccessProbability as SuccessProbability,
    success_probability as success_probability,
)
from bcppl.inference.planning.touching import (
    SurfacePoint as SurfacePoint,
    TouchParameters as TouchParameters,
    pair as pair,
    slide as slide,
    touch as touch,
)
from bcppl.robot.arm_with_peg import ArmWithPeg as ArmWithPeg
