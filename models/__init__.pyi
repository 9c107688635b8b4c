from bcppl.models import (
    arm_calibration as arm_calibration,
    arm_in_view as arm_in_view,
    camera_error as camera_error,
    grasped_peg as grasped_peg,
    look_and_touch as look_and_touch,
    part_in_view as part_in_view,
    parts as parts,
    peg_in_hole as peg_in_hole,
    point_probe as point_probe,
    robots as robots,
    which_hole as which_hole,
    worlds as worlds,
)
from bcppl.models.shipped import load_recording as load_recording
