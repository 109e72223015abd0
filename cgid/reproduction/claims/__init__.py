"""What the paper says, against what is computed."""

from cgid.reproduction.claims.claim import Claim
from cgid.reproduction.claims.contact import contact_claims
from cgid.reproduction.claims.influence import influence_claims
from cgid.reproduction.claims.simulation import simulation_claims
from cgid.reproduction.claims.spheres import sphere_claims
from cgid.reproduction.finite_element import Study, shipped_study

__all__ = ["Claim", "all_claims"]


def all_claims(study: Study | None = None) -> list[Claim]:
    """Return every claim of the paper that is checked, judged, in the order of the paper.

    Parameters
    ----------
    study : Study, optional
        Finite elements that judge what rests on a simulation; those that come with the package if not given.
    """
    return [*contact_claims(), *simulation_claims(study or shipped_study()), *influence_claims(), *sphere_claims()]
