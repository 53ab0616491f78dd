"""What a host without Python needs beside the kernels: where numbers lie, values, workspace."""
