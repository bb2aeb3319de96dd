"""Artefacts: what is wrong with samples, or at a limit, and when; kept apart from mechanics.

A frozen encoder is not a weak servo. Each :class:`~.analysis.results.answer.Artefact` names a
joint, a topic and the stretches of time in which it holds, and says what it is about: the
``sensor`` (the values are not what the joint did), the ``record`` (samples are missing) or a
``limit`` (the robot could not do more; the values are right).
"""
