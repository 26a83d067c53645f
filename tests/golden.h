static const golden golden_table[] = {
  {"", 0, 0, {0, 0, 0, 0}}
};
