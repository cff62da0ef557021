"""The physics: coordinates, kinematics, energies, momenta and equations of motion of a described system."""
