"""What each step's set rests on: certificates of facets, of ellipsoids and of both."""

from reachjax.certificates.base import AbstractCertificate
from reachjax.certificates.ellipsoids import EllipsoidCertificate
from reachjax.certificates.facets import Certificate
from reachjax.certificates.mixed import MixedCertificate

__all__ = ["AbstractCertificate", "Certificate", "EllipsoidCertificate", "MixedCertificate"]
