/* plot.h - diagrams as SVG files: points with a front, bars, curves. Text is in the reader's font; no script, no style
 * sheet. */
#ifndef PAPER_PLOT_H
#define PAPER_PLOT_H
#include "../common.h"

typedef struct paper_axis { double low, high; int log; const char *title; } paper_axis;
typedef struct paper_plot {
  FILE *file;
  const char *path;
  paper_axis x, y;
  double left, top, width, height;     /* of the frame, in pixels */
} paper_plot;
typedef struct paper_label { double x, y; const char *text, *color; int front; } paper_label;

enum { PAPER_COLORS = 8 };
static const char *const paper_colors[PAPER_COLORS] = {
  "#4477aa", "#ee6677", "#228833", "#aa7700", "#66ccee", "#aa3377", "#777777", "#000000"
};
static inline const char *paper_color(int i) { return paper_colors[i % PAPER_COLORS]; }

static inline double paper_along(paper_axis a, double value)   /* 0..1 */
{
  return a.log ? log(value / a.low) / log(a.high / a.low) : (value - a.low) / (a.high - a.low);
}
static inline double paper_x(const paper_plot *p, double value)
{
  return p->left + p->width * paper_along(p->x, value);
}
static inline double paper_y(const paper_plot *p, double value)
{
  return p->top + p->height * (1 - paper_along(p->y, value));
}

/* anchor: start, middle or end */
static inline void paper_text(const paper_plot *p, double x, double y, const char *anchor, const char *color,
                              const char *text)
{
  fprintf(p->file, "<text x=\"%.1f\" y=\"%.1f\" text-anchor=\"%s\" fill=\"%s\">", x, y, anchor, color);
  for (; *text; text++) {
    if (*text == '<') fputs("&lt;", p->file);
    else if (*text == '&') fputs("&amp;", p->file);
    else fputc(*text, p->file);
  }
  fputs("</text>\n", p->file);
}
static inline void paper_line(const paper_plot *p, double x1, double y1, double x2, double y2, const char *color,
                              double width)
{
  fprintf(p->file, "<line x1=\"%.1f\" y1=\"%.1f\" x2=\"%.1f\" y2=\"%.1f\" stroke=\"%s\" stroke-width=\"%.1f\"/>\n",
          x1, y1, x2, y2, color, width);
}
static inline void paper_open_plot(paper_plot *p, const char *path, double width, double height)
{
  p->path = path;
  p->file = fopen(path, "w");
  if (!p->file) ex_die("%s: cannot be written", path);
  fprintf(p->file, "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 %.0f %.0f\" font-family=\"sans-serif\" "
          "font-size=\"12\">\n<rect width=\"%.0f\" height=\"%.0f\" fill=\"#ffffff\"/>\n", width, height, width, height);
}
static inline void paper_close_plot(paper_plot *p)
{
  fputs("</svg>\n", p->file);
  if (fclose(p->file)) ex_die("%s: cannot be written", p->path);
}
static inline void paper_tick(const paper_plot *p, int vertical, double value)
{
  char text[32];
  if (value >= 1e5) snprintf(text, sizeof text, "1e%.0f", log10(value));
  else snprintf(text, sizeof text, "%g", value);
  double x = paper_x(p, value), y = paper_y(p, value);
  if (vertical) {
    paper_line(p, p->left, y, p->left + p->width, y, "#dddddd", 1);
    paper_text(p, p->left - 6, y + 4, "end", "#444444", text);
  } else {
    paper_line(p, x, p->top, x, p->top + p->height, "#dddddd", 1);
    paper_text(p, x, p->top + p->height + 16, "middle", "#444444", text);
  }
}
/* On a logarithmic axis at powers of ten, and at 2 and 5 times them where it is short; else at some round numbers. */
static inline void paper_ticks(const paper_plot *p, int vertical)
{
  paper_axis a = vertical ? p->y : p->x;
  if (a.log) {
    static const double steps[] = {1, 2, 5};
    int per_decade = a.high / a.low < 200 ? 3 : 1;
    for (double ten = pow(10, floor(log10(a.low))); ten <= a.high * 1.001; ten *= 10) {
      for (int i = 0; i < per_decade; i++) {
        double value = ten * steps[i];
        if (value >= a.low * 0.999 && value <= a.high * 1.001) paper_tick(p, vertical, value);
      }
    }
  } else {
    double step = pow(10, floor(log10((a.high - a.low) / 2)));
    if ((a.high - a.low) / step > 10) step *= 2;
    double value = ceil(a.low / step) * step;
    for (; value <= a.high + step / 1e3; value += step) paper_tick(p, vertical, value);
  }
}
static inline void paper_frame(const paper_plot *p)
{
  paper_ticks(p, 0);
  paper_ticks(p, 1);
  fprintf(p->file, "<rect x=\"%.1f\" y=\"%.1f\" width=\"%.1f\" height=\"%.1f\" fill=\"none\" stroke=\"#444444\"/>\n",
          p->left, p->top, p->width, p->height);
  paper_text(p, p->left + p->width / 2, p->top + p->height + 36, "middle", "#000000", p->x.title);
  paper_text(p, p->left, p->top - 10, "start", "#000000", p->y.title);
}

/* Moves labels that would lie on one another down; they are in one column. */
static inline void paper_spread(paper_label *labels, int count, double high)
{
  for (int i = 1; i < count; i++) {    /* from the top down */
    paper_label one = labels[i];
    int k = i;
    for (; k > 0 && labels[k - 1].y > one.y; k--) labels[k] = labels[k - 1];
    labels[k] = one;
  }
  for (int i = 1; i < count; i++) {
    if (labels[i].y < labels[i - 1].y + high) labels[i].y = labels[i - 1].y + high;
  }
}
static inline int paper_by_x(const void *a, const void *b)
{
  double x = ((const paper_label *)a)->x, y = ((const paper_label *)b)->x;
  return (x > y) - (x < y);
}
/* Where a label lies, or a point: x and y are the middle, half sizes. */
typedef struct paper_area { double x, y, width, height; } paper_area;
static inline int paper_covers(paper_area a, const paper_area *others, int count)
{
  for (int i = 0; i < count; i++) {
    paper_area b = others[i];
    if (fabs(a.x - b.x) < a.width + b.width && fabs(a.y - b.y) < a.height + b.height) return 1;
  }
  return 0;
}
/* Each label beside its point, or a little up or down, with a line to it, where there is room. In pixels. */
static inline void paper_label_points(const paper_plot *p, const paper_label *points, int count)
{
  paper_area *taken = (paper_area *)ex_allocate(2 * (size_t)count, sizeof *taken);
  for (int i = 0; i < count; i++) taken[i] = (paper_area){points[i].x, points[i].y, 5, 5};
  for (int i = 0; i < count; i++) {
    double half = 3.3 * (double)strlen(points[i].text);
    paper_area at = taken[i];
    for (int step = 0; step < 40; step++) {   /* to the right, to the left, and again further off */
      double aside = step % 2 ? -half - 9 : half + 9, away = 9 * (double)((step / 2 + 1) / 2);
      at = (paper_area){points[i].x + aside, points[i].y + (step / 2 % 2 ? away : -away), half, 6};
      int across = at.x - half > p->left && at.x + half < p->left + p->width;
      if (across && at.y > p->top && at.y < p->top + p->height && !paper_covers(at, taken, count + i)) break;
    }
    taken[count + i] = at;
    int right = at.x > points[i].x;
    double end = points[i].x + (right ? 8 : -8);
    if (fabs(at.y - points[i].y) > 9) paper_line(p, points[i].x, points[i].y, end, at.y, "#999999", 1);
    paper_text(p, end, at.y + 4, right ? "start" : "end", "#000000", points[i].text);
  }
  free(taken);
}
/* Labelled points; those that no other one beats, less y (or more, where `more` is set) at less x, are joined. Reorders
 * them. */
static inline void paper_plot_points(paper_plot *p, paper_label *points, int count, int more)
{
  double best = more ? -DBL_MAX : DBL_MAX;
  const paper_label *last = NULL;
  qsort(points, (size_t)count, sizeof *points, paper_by_x);
  for (int i = 0; i < count; i++) {
    points[i].front = more ? points[i].y > best : points[i].y < best;
    if (!points[i].front) continue;
    best = points[i].y;
    if (last) {
      double x = paper_x(p, points[i].x), y = paper_y(p, points[i].y);
      paper_line(p, paper_x(p, last->x), paper_y(p, last->y), x, y, "#ee6677", 2);
    }
    last = &points[i];
  }
  for (int i = 0; i < count; i++) {
    points[i].x = paper_x(p, points[i].x);
    points[i].y = paper_y(p, points[i].y);
    fprintf(p->file, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"4.5\" fill=\"%s\"/>\n", points[i].x, points[i].y,
            points[i].front ? "#ee6677" : "#4477aa");
  }
  paper_label_points(p, points, count);
}

#endif
