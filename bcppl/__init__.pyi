from bcppl import (
    beliefs as beliefs,
    contact as contact,
    distributions as distributions,
    figures as figures,
    geometry as geometry,
    inference as inference,
    models as models,
    poses as poses,
    recordings as recordings,
    rendering as rendering,
    robot as robot,
    sensors as sensors,
    traces as traces,
    viewer as viewer,
)
from bcppl.beliefs import Belief as Belief
from bcppl.errors import InferenceError as InferenceError, InputError as InputError
from bcppl.geometry.camera import Camera as Camera
from bcppl.geometry.parts import Guess as Guess, Part as Part
from bcppl.inference import Population as Population, infer as infer, live as live, smc as smc
from bcppl.recordings import load as load, save as save
from bcppl.sensors import (
    DepthImage as DepthImage,
    Measurement as Measurement,
    Plan as Plan,
    Probe as Probe,
    ProbeWindow as ProbeWindow,
    Push as Push,
    Recording as Recording,
    Touch as Touch,
    View as View,
)
from bcppl.traces import (
    Model as Model,
    Series as Series,
    Trace as Trace,
    assess as assess,
    extend as extend,
    generate as generate,
    gradients as gradients,
    propose as propose,
    regenerate as regenerate,
    simulate as simulate,
    structural as structural,
    update as update,
)
from bcppl.viewer import view as view
