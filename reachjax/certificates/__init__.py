"""What each step's set rests on: certificates of facets and of ellipsoids."""

from reachjax.certificates.base import AbstractCertificate
from reachjax.certificates.ellipsoids import EllipsoidCertificate
from reachjax.certificates.facets import Certificate

__all__ = ["AbstractCertificate", "Certificate", "EllipsoidCertificate"]
