"""Text-driven 3D human motion from a multi-track timeline (STMC, Petrovich et al., CVPRW 2024)."""
