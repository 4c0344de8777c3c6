"""Ground that all parts share: data, poses, errors, reasons, files, sensors, uncertainty, words."""
