from bcppl.inference.planning.candidate_list import candidates as candidates
from bcppl.inference.planning.chance import chance_of_success as chance_of_success
from bcppl.inference.planning.filters import (
    Candidates as Candidates,
    Filter as Filter,
    Mounted as Mounted,
    clear_of_part as clear_of_part,
    clear_of_table as clear_of_table,
    from_within as from_within,
    meeting as meeting,
    no_harder_than as no_harder_than,
    no_longer_than as no_longer_than,
    not_from_below as not_from_below,
    within_reach as within_reach,
)
from bcppl.inference.planning.insertion import Attempt as Attempt, insertion_plan as insertion_plan
from bcppl.inference.planning.metrology import Pace as Pace, three_two_one as three_two_one
from bcppl.inference.planning.touching import (
    Touching as Touching,
    pair as pair,
    slide as slide,
    touch as touch,
)
