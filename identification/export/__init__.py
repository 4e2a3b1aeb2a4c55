"""What leaves an identification: parameters, friction and URDF as files."""
