"""The model of the tippe top: bodies, launches, scenes, and the equations of motion.

A `Scene` contains a body, an arena, a friction law and gravity. Its `dynamics` are the equations of slipping
(`dynamics`), of rolling, or of stick and slip, including the onset of slip. Other subpackages integrate these
equations.
"""
