from bcppl.contact.sensing.contact_detection import ContactDetector as ContactDetector
from bcppl.contact.sensing.intrinsic import IntrinsicSensing as IntrinsicSensing
from bcppl.contact.sensing.load import (
    ToolLoad as ToolLoad,
    identify_load as identify_load,
    transform_wrench as transform_wrench,
)
from bcppl.contact.sensing.location import ContactSensing as ContactSensing
from bcppl.contact.sensing.noise import WrenchNoise as WrenchNoise, noise_at_rest as noise_at_rest
from bcppl.contact.sensing.onset import OnsetDetector as OnsetDetector
