from bcppl.inference.annealing.persistent import persistent_sampling as persistent_sampling
from bcppl.inference.annealing.replicas import Replicas as Replicas, replica_exchange as replica_exchange
