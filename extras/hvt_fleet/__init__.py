"""For many edges and grounds: `pki` makes their keys, and says who may do what; `edge_doctor` examines one edge."""
