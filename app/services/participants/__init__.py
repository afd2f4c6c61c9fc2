"""Enrolment, consent, stages, forms, withdrawal."""
