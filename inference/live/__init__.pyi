from bcppl.inference.live.client import Client as Client
from bcppl.inference.live.filter import Filter as Filter
from bcppl.inference.live.playing import play as play
from bcppl.inference.live.sampler import Sampler as Sampler
from bcppl.inference.live.updates import UpdateInfo as UpdateInfo
