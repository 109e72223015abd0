"""What the paper says, against what is computed."""

from cgid.reproduction.claims.claim import Claim
from cgid.reproduction.claims.contact import contact_claims
from cgid.reproduction.claims.influence import influence_claims
from cgid.reproduction.claims.simulation import simulation_claims
from cgid.reproduction.claims.spheres import sphere_claims

__all__ = ["Claim", "all_claims"]


def all_claims() -> list[Claim]:
    """Return every claim of the paper that is checked, judged, in the order of the paper."""
    return [*contact_claims(), *simulation_claims(), *influence_claims(), *sphere_claims()]
