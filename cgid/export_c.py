"""A model as one C99 file: features in, answer out, for controllers and programs without Python.

The file depends on the C library alone, allocates nothing, and has no state. It repeats `Model.probabilities`,
`Model.novelty`, `Model.decide` and `Model.prediction_set`; whoever calls it measures the features.
"""

from __future__ import annotations

import hashlib
import re
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import __version__
from cgid.errors import InvalidValue
from cgid.identification.conformal import COVERAGES
from cgid.identification.families import Contrast, Standardiser
from cgid.identification.model import LOWEST_SHARE, Model
from cgid.identification.model_file import STANDARDISER
from cgid.measure.features import FEATURES
from cgid.measure.spectra import THIRD_OCTAVES, third_octave
from cgid.measure.vibration import EARLY_BANDS, EARLY_TIME, WINDOW_TIME
from cgid.signals import KNOWN
from cgid.validation import Floats

#: Most numbers in an exported file: 8 MiB of constants in double precision.
MOST_NUMBERS = 1 << 20
#: Largest and smallest constants of a file that may be compiled with single precision.
_SINGLE = (1e-37, 1e37)
#: Standard deviations from the middle of the training of the rows that a file tests itself with.
_TESTED = (-1.5, -0.75, 0.0, 0.75, 1.5)
_LONGEST_LINE = 116
#: Tables that stay double in single precision.
_ALWAYS_DOUBLE = ("cgid_coverages", "set_limits", "test_probabilities", "band_edges")

_TYPES = """\
#ifndef CGID_REAL
#define CGID_REAL double
#endif
typedef CGID_REAL cgid_real;
"""

_INTERFACE = """\
/* The label of an impact that the model does not know: another label must not be given to it. */
#define CGID_UNKNOWN (-1)

typedef enum {
    CGID_KNOWN = 0,      /* the label is the most probable one */
    CGID_OUTSIDE = 1,    /* unknown: the novelty is above 1, outside of the training */
    CGID_UNMEASURED = 2, /* unknown: a value is infinite or not a number; the other fields are not numbers */
    CGID_OVERFLOW = 3    /* unknown: the values are so large that the model gives no probabilities */
} cgid_status;

typedef struct {
    cgid_status status;
    int label;                             /* number of the label, or CGID_UNKNOWN */
    cgid_real novelty;                     /* distance from the training, 1 at its edge */
    cgid_real probability[CGID_N_LABELS];  /* calibrated; in the order of cgid_labels */
} cgid_answer;

extern const char *const cgid_labels[CGID_N_LABELS];
extern const char *const cgid_values[CGID_N_VALUES];

/* Identify one impact from its CGID_N_VALUES values, in the order of cgid_values; return the status. */
cgid_status cgid_identify(const cgid_real *values, cgid_answer *answer);

/* Return the label of the smallest expected cost; `costs` are those of missing each label. */
int cgid_decide(const cgid_real *probability, const cgid_real *costs);

/* Return 1 if the model was trained for a sampling rate [Hz], else 0. */
int cgid_covers(double sampling_rate);

/* Return the number of wrong answers to a few impacts that cgid itself has answered: 0 if compiler, processor and
   options are sound. */
int cgid_self_test(void);
"""

_SETS = """\

/* Coverages of the prediction sets. */
#define CGID_N_COVERAGES %(n)d
extern const double cgid_coverages[CGID_N_COVERAGES];

/* Find the labels that cannot be ruled out, held[label] = 1, at the coverage of this number; return how many. For
   impacts like those of the training, this share of the sets holds the truth: for the mix of labels of the training,
   or with by_label = 1 for each label. Where too few impacts were left out for a limit, no label is ruled out. */
int cgid_prediction_set(const cgid_real *probability, int coverage, int by_label, unsigned char *held);
"""

_MEASURE = """\

/* Measure one frame of a vibration: n_samples in the unit of the model, of which the first pre_trigger precede the touch.
   Return 1, or 0 and values that are not numbers if it cannot be measured. Computes in double precision; its time grows
   with the number of samples times the number of bins of the spectrum up to the highest band. */
int cgid_measure(const cgid_real *samples, int n_samples, int pre_trigger, double sampling_rate, cgid_real *values);
"""

_MEASURE_BODY = """\

/* An impact in a frame: samples from the onset on, and what they are relative to. */
typedef struct {
    const cgid_real *samples;
    int n;               /* in the frame */
    int longest;         /* of any event at this rate and length of frames */
    double rate, offset, noise;
} event;

/* Weight of a sample: exp(-t / 15 ms), or half a cosine bell over the first n_early samples. */
static double weight_of(int i, int n_early, double rate)
{
    double bell = n_early ? cos(i * (0.5 * PI / n_early)) : 0;
    return n_early ? bell * bell : exp(-i / (WINDOW_TIME * rate));
}

/* Return the energy of bin k of the spectrum of the first n weighted samples, padded to a length: one term of the
   Fourier sum after the other, turned and faded by one product each. */
static double energy_of(const event *own, int n, int n_early, int length, int k)
{
    const double angle = 2 * PI * k / length, fade = n_early ? 1 : exp(-1 / (WINDOW_TIME * own->rate));
    const double turn_re = fade * cos(angle), turn_im = -fade * sin(angle);
    double re = 1, im = 0, sum_re = 0, sum_im = 0;
    int i;
    for (i = 0; i < n; i++) {
        double value = (double)own->samples[i] - own->offset, old = re;
        if (n_early) {
            value *= weight_of(i, n_early, own->rate);
        }
        sum_re += value * re;
        sum_im += value * im;
        re = old * turn_re - im * turn_im;
        im = old * turn_im + im * turn_re;
    }
    return (sum_re * sum_re + sum_im * sum_im) * (k == 0 || 2 * k == length ? 1 : 2) / (length * own->rate);
}

/* Find the bin of a frequency; return the share of it that lies below. The first and the last one have half a width. */
static double bin_of(double frequency, double spacing, int last, int *k)
{
    double place = frequency / spacing + 0.5, share;
    *k = place < last ? (int)place : last;
    share = place - *k;
    if (*k == 0 || *k == last) {
        share = 2 * share - (*k == 0);
    }
    return share < 1 ? share : 1;
}

/* Return a length with a fast transform, which cgid pads to: four to eight times a power of two. */
static int padded_length(int wanted)
{
    int bits = 0, step;
    while (wanted >> bits) {
        bits++;
    }
    step = 1 << (bits > 4 ? bits - 3 : 1);
    return (wanted + step - 1) / step * step;
}

/* Return log10 of the energy between two frequencies less the share of the noise; equal ones stand for all. */
static double level_of(const event *own, double low, double high, int early)
{
    int bell = (int)rint(EARLY_TIME * own->rate), i, k, first, last, n_early = 0, n = own->n, length;
    double below, inside, energy = 0, total = 0, weights = 0, share;
    if (early) {
        bell = bell > 2 ? bell : 2;
        n_early = bell < own->longest ? bell : own->longest;
        n = n < n_early ? n : n_early;
    }
    for (i = 0; i < (early ? n_early : n); i++) {
        double weight = weight_of(i, n_early, own->rate);
        double value = i < n ? ((double)own->samples[i] - own->offset) * weight : 0;
        weights += weight * weight / own->rate;
        total += value * value / own->rate;
    }
    length = padded_length(early ? 4 * n_early : own->longest);
    below = bin_of(low, own->rate / length, length / 2, &first);
    inside = bin_of(high, own->rate / length, length / 2, &last);
    for (k = first; k <= last && low < high; k++) {
        energy += ((k == last ? inside : 1) - (k == first ? below : 0)) * energy_of(own, n, n_early, length, k);
    }
    energy = low < high ? energy : total;
    share = own->noise * own->noise * weights * (low < high ? 2 * (high - low) / own->rate : 1);
    return log10(fmax(energy - share, fmax(share, fmax(1e-12 * total, DBL_MIN))));
}

/* Return whether rate and length of a frame suffice for all bands. */
static int suffice(int n_samples, double rate)
{
    int k, enough = rate >= 2000 && rate <= 1e8;
    for (k = 0; k < CGID_N_VALUES; k++) {
        const double *edges = band_edges + 2 * k;
        enough = enough && rate >= 2 * edges[1];
        enough = enough && (band_early[k] || edges[0] >= edges[1] || n_samples >= rate / (edges[1] - edges[0]));
    }
    return enough;
}

int cgid_measure(const cgid_real *samples, int n_samples, int pre_trigger, double sampling_rate, cgid_real *values)
{
    event own;
    double peak = 0, limit, square = 0, sum = 0;
    int i, k, first = pre_trigger, varies = 0, sound = suffice(n_samples, sampling_rate);
    for (k = 0; k < CGID_N_VALUES; k++) {
        values[k] = (cgid_real)NAN;
    }
    for (i = 0; i < n_samples; i++) {
        sound = sound && fabs((double)samples[i]) <= 1e150;
        varies = varies || samples[i] > samples[0] || samples[i] < samples[0];
    }
    if (!sound || !varies || pre_trigger < 0 || pre_trigger >= n_samples) {
        return 0;
    }
    for (i = 0; i < pre_trigger; i++) {
        sum += (double)samples[i];
    }
    own.rate = sampling_rate;
    own.offset = pre_trigger > 1 ? sum / pre_trigger : 0;
    for (i = 0; i < pre_trigger; i++) {
        square += ((double)samples[i] - own.offset) * ((double)samples[i] - own.offset);
    }
    own.noise = pre_trigger > 1 ? sqrt(square / (pre_trigger - 1)) : 0;
    for (i = pre_trigger; i < n_samples; i++) {
        peak = fmax(peak, fabs((double)samples[i] - own.offset));
    }
    if (!(peak > 5 * own.noise) || !(peak > 1e-75)) {
        return 0;
    }
    limit = fmax(0.05 * peak, fmin(5 * own.noise, 0.8 * peak));
    while (!(fabs((double)samples[first] - own.offset) > limit)) {
        first++;
    }
    own.samples = samples + first;
    own.longest = (int)ceil(0.2 * sampling_rate) < n_samples ? (int)ceil(0.2 * sampling_rate) : n_samples;
    own.n = n_samples - first < own.longest ? n_samples - first : own.longest;
    if (n_samples - first < 0.005 * sampling_rate) {
        return 0;
    }
    for (k = 0; k < CGID_N_VALUES; k++) {
        double level = level_of(&own, band_edges[2 * k], band_edges[2 * k + 1], band_early[k]);
        values[k] = (cgid_real)(level - (band_relative[k] ? level_of(&own, 0, 0, 0) : 0));
    }
    return 1;
}
"""

_ARITHMETIC = """\
#include <float.h>
#include <math.h>

#define CGID_JOIN_(a, b) a##b
#define CGID_JOIN(a, b) CGID_JOIN_(a, b)
#define CGID_BYTES_float 4
#define CGID_BYTES_double 8
#if CGID_JOIN(CGID_BYTES_, CGID_REAL) == 8
#define CGID_EXP exp
#define CGID_LOG log
#define CGID_SQRT sqrt
#define CGID_TANH tanh
#define CGID_READ strtod
#define CGID_TOLERANCE 1e-9
#define CGID_LARGEST 100
#define CGID_DIGITS 17
#elif CGID_JOIN(CGID_BYTES_, CGID_REAL) == 4
%(single)s#define CGID_EXP expf
#define CGID_LOG logf
#define CGID_SQRT sqrtf
#define CGID_TANH tanhf
#define CGID_READ strtof
#define CGID_TOLERANCE 1e-3
#define CGID_LARGEST 80
#define CGID_DIGITS 9
#else
#error "CGID_REAL must be float or double"
#endif
"""

_STANDARDISE = """\
/* Take logarithms of the features that are always positive, then scale to zero mean and unit variance. */
static void standardise(const cgid_real *values, int n, const unsigned char *logarithmic, const cgid_real *least,
                        const cgid_real *mean, const cgid_real *scale, cgid_real *out)
{
    int i;
    for (i = 0; i < n; i++) {
        cgid_real value = values[i];
        if (logarithmic[i]) {
            value = CGID_LOG(value > least[i] ? value : least[i]);
        }
        out[i] = (value - mean[i]) / scale[i];
    }
}
"""

_LAYER = """\
/* One layer of a network: out = x weights + biases, through tanh if it is hidden. */
static void layer(const cgid_real *x, int n_inputs, const cgid_real *weights, const cgid_real *biases, int n_units,
                  int hidden, cgid_real *out)
{
    int i, k;
    for (k = 0; k < n_units; k++) {
        out[k] = biases[k];
    }
    for (i = 0; i < n_inputs; i++) {
        for (k = 0; k < n_units; k++) {
            out[k] += x[i] * weights[i * n_units + k];
        }
    }
    for (k = 0; hidden && k < n_units; k++) {
        out[k] = CGID_TANH(out[k]);
    }
}
"""

#: Family -> the C function `scores`: those of the classes, for two classes only that of the second.
_SCORES = {
    "linear": """\
/* Linear in the features. */
static void scores(const cgid_real *x, cgid_real *score)
{
    int i, k;
    for (k = 0; k < N_SCORES; k++) {
        score[k] = family_intercepts[k];
        for (i = 0; i < CGID_N_INPUTS; i++) {
            score[k] += family_coefficients[k * CGID_N_INPUTS + i] * x[i];
        }
    }
}
""",
    "logistic": """\
/* Linear in the features and their pairwise products. */
static void scores(const cgid_real *x, cgid_real *score)
{
    const cgid_real *coefficient = family_coefficients;
    int i, j, k;
    for (k = 0; k < N_SCORES; k++) {
        score[k] = family_intercepts[k];
        for (i = 0; i < CGID_N_INPUTS; i++) {
            score[k] += *coefficient++ * x[i];
        }
        for (i = 0; i < CGID_N_INPUTS; i++) {
            for (j = i; j < CGID_N_INPUTS; j++) {
                score[k] += *coefficient++ * (x[i] * x[j]);
            }
        }
    }
}
""",
    "boosting": """\
/* Sums of decision trees. A leaf is its own child, and its number is its value; of other nodes it is a threshold. */
static void scores(const cgid_real *x, cgid_real *score)
{
    int k, tree;
    for (k = 0; k < N_SCORES; k++) {
        score[k] = family_baseline[k];
    }
    for (tree = 0; tree < N_TREES; tree++) {
        unsigned long node = family_roots[tree];
        while (family_left[node] != node) {
            node = x[family_feature[node]] <= family_number[node] ? family_left[node] : family_right[node];
        }
        score[family_columns[tree]] += family_number[node];
    }
}
""",
    "network": """\
/* Two hidden layers. */
static void scores(const cgid_real *x, cgid_real *score)
{
    cgid_real first[N_UNITS_1], second[N_UNITS_2];
    layer(x, CGID_N_INPUTS, family_weights_1, family_biases_1, N_UNITS_1, 1, first);
    layer(first, N_UNITS_1, family_weights_2, family_biases_2, N_UNITS_2, 1, second);
    layer(second, N_UNITS_2, family_weights_3, family_biases_3, N_SCORES, 0, score);
}
""",
}

_PROBABILITIES = """\
/* Softmax of the scores over the temperature; return whether all probabilities are finite. */
static int probabilities(const cgid_real *x, cgid_real *probability)
{
    cgid_real highest, sum = 0;
    int k, finite = 1;
    probability[0] = 0;
    scores(x, probability + (CGID_N_LABELS - N_SCORES));
    for (k = CGID_N_LABELS - N_SCORES; k < CGID_N_LABELS; k++) {
        probability[k] /= temperature;
    }
    highest = probability[0];
    for (k = 1; k < CGID_N_LABELS; k++) {
        highest = probability[k] > highest ? probability[k] : highest;
    }
    for (k = 0; k < CGID_N_LABELS; k++) {
        probability[k] = CGID_EXP(probability[k] - highest);
        sum += probability[k];
    }
    for (k = 0; k < CGID_N_LABELS; k++) {
        probability[k] /= sum;
        finite = finite && isfinite(probability[k]);
    }
    return finite;
}

/* Mahalanobis distance to the nearest class over its limit. */
static cgid_real distance(const cgid_real *x)
{
    cgid_real nearest = 0;
    int i, j, k;
    for (k = 0; k < CGID_N_LABELS; k++) {
        const cgid_real *row = neighbourhood_whitening + (k % N_WHITENINGS) * CGID_N_INPUTS * CGID_N_INPUTS;
        cgid_real sum = 0;
        for (i = 0; i < CGID_N_INPUTS; i++, row += CGID_N_INPUTS) {
            cgid_real white = 0;
            for (j = 0; j < CGID_N_INPUTS; j++) {
                white += (x[j] - neighbourhood_centres[k * CGID_N_INPUTS + j]) * row[j];
            }
            sum += white * white;
        }
        /* A sum that is not a number stays the nearest, so that its impact is unknown. */
        if (k == 0 || sum < nearest || isnan(sum)) {
            nearest = sum;
        }
    }
    return CGID_SQRT(nearest) / neighbourhood_limit;
}
"""

_CONTRAST = """\
/* Novelty against anything else: a network that tells the training from strangers, by features and guards. */
static cgid_real contrast(const cgid_real *values)
{
    cgid_real x[N_CONTRASTED], first[N_CONTRAST_1], second[N_CONTRAST_2], score;
    int i;
    for (i = 0; i < N_CONTRASTED; i++) {
        x[i] = values[i < N_FEATURES ? i : i - N_FEATURES + CGID_N_INPUTS];
    }
    standardise(x, N_CONTRASTED, contrast_logarithmic, contrast_floor, contrast_mean, contrast_scale, x);
    layer(x, N_CONTRASTED, contrast_weights_1, contrast_biases_1, N_CONTRAST_1, 1, first);
    layer(first, N_CONTRAST_1, contrast_weights_2, contrast_biases_2, N_CONTRAST_2, 1, second);
    layer(second, N_CONTRAST_2, contrast_weights_3, contrast_biases_3, 1, 0, &score);
    score = (score - contrast_limit) / contrast_spread;
    return CGID_EXP(score > CGID_LARGEST ? (cgid_real)CGID_LARGEST : score);
}
"""

_NOVELTY = """\
/* The largest of the distance, the guards over their limits, and the contrast; infinite beyond all numbers. */
static cgid_real novelty(const cgid_real *values, const cgid_real *x)
{
    cgid_real most = distance(x);
%(unused)s%(more)s    return isnan(most) ? (cgid_real)HUGE_VAL : most;
}
"""

_GUARDS = """\
    for (int i = 0; i < N_GUARDS; i++) {
        cgid_real guard = values[CGID_N_INPUTS + i] / guard_limits[i];
        most = guard > most ? guard : most;
    }
"""

_STRANGERS = """\
    cgid_real stranger = contrast(values);
    most = stranger > most || isnan(stranger) ? stranger : most;
"""

_ANSWER = """\
static const cgid_real even_costs[CGID_N_LABELS] = {%(ones)s};

int cgid_decide(const cgid_real *probability, const cgid_real *costs)
{
    int k, best = 0;
    for (k = 1; k < CGID_N_LABELS; k++) {
        if (probability[k] * costs[k] > probability[best] * costs[best]) {
            best = k;
        }
    }
    return best;
}

int cgid_covers(double sampling_rate)
{
    return sampling_rate >= %(lowest)s && sampling_rate <= %(highest)s;
}

cgid_status cgid_identify(const cgid_real *values, cgid_answer *answer)
{
    cgid_real x[CGID_N_INPUTS];
    int i, finite = 1;
    answer->label = CGID_UNKNOWN;
    for (i = 0; i < CGID_N_VALUES; i++) {
        finite = finite && isfinite(values[i]);
    }
    if (!finite) {
        answer->novelty = (cgid_real)NAN;
        for (i = 0; i < CGID_N_LABELS; i++) {
            answer->probability[i] = (cgid_real)NAN;
        }
        return answer->status = CGID_UNMEASURED;
    }
    standardise(values, CGID_N_INPUTS, standardiser_logarithmic, standardiser_floor, standardiser_mean,
                standardiser_scale, x);
    finite = probabilities(x, answer->probability);
    answer->novelty = novelty(values, x);
    if (!finite) {
        return answer->status = CGID_OVERFLOW;
    }
    if (!(answer->novelty <= 1)) {
        return answer->status = CGID_OUTSIDE;
    }
    answer->label = cgid_decide(answer->probability, even_costs);
    return answer->status = CGID_KNOWN;
}

int cgid_self_test(void)
{
    cgid_answer answer;
    int i, k, wrong = 0;
    for (i = 0; i < N_TESTS; i++) {
        int same = 1;
        cgid_identify(test_values + i * CGID_N_VALUES, &answer);
        for (k = 0; k < CGID_N_LABELS; k++) {
            double error = (double)answer.probability[k] - test_probabilities[i * CGID_N_LABELS + k];
            same = same && fabs(error) <= CGID_TOLERANCE;
        }
        wrong += !same;
    }
    return wrong;
}
"""

_SETS_BODY = """\

int cgid_prediction_set(const cgid_real *probability, int coverage, int by_label, unsigned char *held)
{
    const double *limit = set_limits + ((by_label ? CGID_N_COVERAGES : 0) + coverage) * CGID_N_LABELS;
    int k, n = 0;
    for (k = 0; k < CGID_N_LABELS; k++) {
        held[k] = 1.0 - (double)probability[k] <= limit[k];
        n += held[k];
    }
    return n;
}
"""

_MAIN = r"""
#ifdef CGID_MAIN
/* Read a CSV of impacts, from a file or the standard input, and print one answer a line. A first line of names, such
   as `cgid features` prints, says which columns hold the values; without it they come in the order of cgid_values. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static char line[64 * CGID_N_VALUES + 16384];

/* Return the next field of a line, its quotes taken off; NULL after the last one. */
static char *next_field(char **rest)
{
    char *start = *rest, *from = *rest, *to = *rest;
    int quoted = 0;
    if (start == NULL) {
        return NULL;
    }
    for (; *from && (quoted || (*from != ',' && *from != '\n' && *from != '\r')); from++) {
        if (*from != '"') {
            *to++ = *from;
        } else if (quoted && from[1] == '"') {
            *to++ = *from++;
        } else {
            quoted = !quoted;
        }
    }
    *rest = *from == ',' ? from + 1 : NULL;
    *to = '\0';
    return start;
}

/* Read a number, of an empty field nan; return whether the field holds one. */
static int number_of(const char *field, cgid_real *value)
{
    char *end;
    *value = (cgid_real)NAN;
    if (*field == '\0') {
        return 1;
    }
    *value = CGID_READ(field, &end);
    return end != field && *end == '\0';
}

/* Return whether a line begins with a number or an empty field, so it is no line of names. */
static int is_row(const char *text)
{
    char *end;
    strtod(text, &end);
    return *text == ',' || (end != text && (*end == ',' || *end == '\n' || *end == '\r' || *end == '\0'));
}

/* Return the number of the value of a column named `name` or `name [unit]`; -1 if it is none. */
static int value_named(const char *name)
{
    int i;
    for (i = 0; i < CGID_N_VALUES; i++) {
        size_t length = strlen(cgid_values[i]);
        if (strncmp(name, cgid_values[i], length) == 0 && (!name[length] || strncmp(name + length, " [", 2) == 0)) {
            return i;
        }
    }
    return -1;
}

/* Say what is wrong with a line; return the exit code for bad data. */
static int complain(unsigned long number, const char *what, const char *name)
{
    fprintf(stderr, "line %lu: %s%s\n", number, what, name);
    return 65;
}

/* Find the column of each value in a line of names; return an exit code. */
static int read_names(char *rest, unsigned long number, int *column)
{
    char *field;
    int i, k;
    for (i = 0; i < CGID_N_VALUES; i++) {
        column[i] = -1;
    }
    for (k = 0; (field = next_field(&rest)) != NULL; k++) {
        i = value_named(field);
        if (i >= 0) {
            column[i] = k;
        }
    }
    for (i = 0; i < CGID_N_VALUES; i++) {
        if (column[i] < 0) {
            return complain(number, "there must be a column ", cgid_values[i]);
        }
    }
    return 0;
}

/* Read the values of a line; return an exit code. */
static int read_values(char *rest, unsigned long number, const int *column, cgid_real *values)
{
    char *field;
    int i, k, found = 0;
    for (k = 0; (field = next_field(&rest)) != NULL; k++) {
        for (i = 0; i < CGID_N_VALUES; i++) {
            if (column[i] == k) {
                if (!number_of(field, values + i)) {
                    return complain(number, "there must be a number, got ", field);
                }
                found++;
            }
        }
    }
    return found == CGID_N_VALUES ? 0 : complain(number, "there must be a field for each value", "");
}

static void print_number(cgid_real value)
{
    printf(",");
    if (!isnan(value)) {
        printf("%.*g", CGID_DIGITS, (double)value);
    }
}

static void print_answer(const cgid_answer *answer)
{
    static const char *const problems[] = {"", "outside of the training", "a value is missing or not finite",
                                           "no probabilities of values so large"};
    int k;
    printf("%s", answer->label == CGID_UNKNOWN ? "unknown" : cgid_labels[answer->label]);
    for (k = 0; k < CGID_N_LABELS; k++) {
        print_number(answer->probability[k]);
    }
    print_number(answer->novelty);
    printf(",%s\n", problems[answer->status]);
}

int main(int argc, char **argv)
{
    static int column[CGID_N_VALUES];
    static cgid_real values[CGID_N_VALUES];
    FILE *stream = argc > 1 ? fopen(argv[1], "r") : stdin;
    unsigned long number = 0;
    int k, code = 0, first = 1;
    if (stream == NULL) {
        fprintf(stderr, "%s: cannot be read (%s)\n", argv[1], strerror(errno));
        return 66;
    }
    if (cgid_self_test()) {
        fprintf(stderr, "the self-test failed: compile without -ffast-math\n");
        return 70;
    }
    printf("label");
    for (k = 0; k < CGID_N_LABELS; k++) {
        printf(",p(%s)", cgid_labels[k]);
    }
    printf(",novelty,problem\n");
    for (k = 0; k < CGID_N_VALUES; k++) {
        column[k] = k;
    }
    while (!code && fgets(line, (int)sizeof line, stream) != NULL) {
        cgid_answer answer;
        number++;
        if (strchr(line, '\n') == NULL && !feof(stream)) {
            code = complain(number, "it must be shorter", "");
        } else if (line[0] == '#' || line[strspn(line, " \r\n")] == '\0') {
            continue;
        } else if (first && !is_row(line)) {
            code = read_names(line, number, column);
            first = 0;
        } else if ((code = read_values(line, number, column, values)) == 0) {
            cgid_identify(values, &answer);
            print_answer(&answer);
            first = 0;
        }
    }
    return fflush(stdout) && !code ? 74 : code;
}
#endif
"""


def c_source(model: Model) -> str:
    """Return a C99 file that answers like the model.

    Parameters
    ----------
    model : Model

    Returns
    -------
    str
        ASCII text. The numbers are exact; `CGID_REAL` is `double`, or `float` if the compiler receives
        `-DCGID_REAL=float`.

    Raises
    ------
    InvalidValue
        The model has more numbers than a controller could hold.

    Examples
    --------
    >>> from cgid import load_model
    >>> print(c_source(load_model("default")).splitlines()[3])
     * For     pulses of force [N] at sampling rates of 24589.4 to 1.01263e+06 Hz
    """
    require_small(model)
    arrays = _arrays(model)
    parts = [_heading(model), "#ifndef CGID_MODEL_C\n#define CGID_MODEL_C\n", _sizes(model), _TYPES, _interface(model)]
    parts += ["#endif\n", "#ifndef CGID_HEADER\n", _ARITHMETIC % {"single": _single(arrays)}, _inner_sizes(model)]
    parts += [_strings("cgid_labels", "CGID_N_LABELS", model.labels)]
    parts += [_strings("cgid_values", "CGID_N_VALUES", (*model.inputs, *model.guards))]
    parts += [_table(name, array) for name, array in arrays.items()]
    parts += [_STANDARDISE, *([_LAYER] if _has_layers(model) else []), _SCORES[model.family], _PROBABILITIES]
    parts += [*([_CONTRAST] if model.contrast is not None else []), _novelty(model), _answer(model)]
    parts += [_MAIN.lstrip("\n"), "#endif\n"]
    return "\n".join(parts)


def require_small(model: Model) -> None:
    """Raise `InvalidValue` if a model has more numbers than an exported file may hold."""
    names = ("family.", "neighbourhood.", Contrast.PREFIX)
    n_numbers = sum(array.size for name, array in model.arrays.items() if name.startswith(names))
    if n_numbers > MOST_NUMBERS:
        raise InvalidValue(
            f"the model must hold at most {MOST_NUMBERS} numbers to be exported, got {n_numbers} for "
            f"{len(model.inputs)} inputs; train one on fewer features (--features)"
        )


# -- the parts that follow from the model -----------------------------------------------------------------


def _values(model: Model) -> list[tuple[str, str, str]]:
    """Return name, unit and definition of each value of an impact."""
    found = []
    for name in (*model.inputs, *model.guards):
        feature = FEATURES[name.partition(" of channel ")[0]] if name not in model.known else None
        unit = KNOWN[name] if feature is None else feature.unit_for(model.unit)
        found.append((name, unit, "known besides the signal" if feature is None else feature.definition))
    return found


def _heading(model: Model) -> str:
    low, high = model.sampling_rates
    rates = f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"
    lines = [
        f"A model of cgid as one C99 file: written by cgid {__version__}, without dependencies and allocation.",
        "",
        f"Model   {model.family}, SHA-256 of the file {hashlib.sha256(model.to_bytes()).hexdigest()}",
        f"For     {model.kind}s of {model.quantity} [{model.unit}] at sampling rates of {rates}",
        f"Labels  {', '.join(f'{k}: {label}' for k, label in enumerate(model.labels))}",
        "",
        "Values of an impact, in this order; name [unit], definition:",
        *(f"  {k:3d}  {name} [{unit}], {told}" for k, (name, unit, told) in enumerate(_values(model))),
        "",
        *_missing(model),
        "",
        "    cgid_real values[CGID_N_VALUES] = {...};",
        "    cgid_answer answer;",
        "    if (cgid_identify(values, &answer) == CGID_KNOWN) { ... cgid_labels[answer.label] ... }",
        "",
        "cc -std=c99 -O2 -c FILE.c               link with -lm; -DCGID_REAL=float for single precision",
        "cc -std=c99 -O2 -DCGID_MAIN FILE.c -lm  a program that answers to the rows of a CSV",
        "Other files declare what is here by #define CGID_HEADER and #include of this file. Never use -ffast-math.",
    ]
    wrapped = [textwrap.wrap(line, _LONGEST_LINE - 3, subsequent_indent=" " * 8) or [""] for line in lines]
    return "/* " + "\n".join(f" * {line}".rstrip() for part in wrapped for line in map(_comment, part))[3:] + "\n */\n"


def _missing(model: Model) -> Iterable[str]:
    """Yield what is not in the file."""
    if _bands(model) is not None:
        yield "Not in this file: finding the impacts in a recording. cgid_measure measures a frame of one impact."
        return
    yield "Not in this file: finding the impacts in a recording, and measuring these values. `cgid features` measures"
    if model.beam is not None:
        yield "them, except those named beam_*: they need the beam of the model, and cgid itself."
    else:
        yield "them; what is fitted is fitted to the samples, not read off them."
    if model.sensors:
        yield "Nor the equalisation of the sensors: measure the features of equalised samples."
    if model.kind == "window":
        yield "Nor the vote of successive windows: cgid averages the logarithms of their probabilities."


def _sizes(model: Model) -> str:
    return (
        "\n".join(
            f"#define {name} {number}"
            for name, number in (
                ("CGID_N_LABELS", len(model.labels)),
                ("CGID_N_INPUTS", len(model.inputs)),
                ("CGID_N_VALUES", len(model.inputs) + len(model.guards)),
            )
        )
        + "\n"
    )


def _interface(model: Model) -> str:
    sets = _SETS % {"n": len(COVERAGES)} if model.conformal is not None else ""
    return _INTERFACE + sets + (_MEASURE if _bands(model) is not None else "")


def _bands(model: Model) -> dict[str, NDArray[Any]] | None:
    """Return the tables of the bands, if all values are levels of a vibration that C measures.

    Edges are in Hz; equal ones stand for the level of all frequencies.
    """
    octaves = {name: third_octave(number) for number, name in enumerate(THIRD_OCTAVES)}
    levels = {"level_total": (0.0, 0.0)} | {f"level_{name}_hz": edges for name, edges in octaves.items()}
    relative = {f"relative_level_{name}_hz": edges for name, edges in octaves.items()}
    early = {f"early_level_{low}_{high}_hz": (low, high) for low, high in EARLY_BANDS}
    edges, names = levels | relative | early, model.measured
    if model.n_channels > 1 or model.known or model.sensors or not edges.keys() >= set(names):
        return None
    return {
        "band_edges": np.array([edges[name] for name in names], np.float64),
        "band_early": np.array([name in early for name in names]),
        "band_relative": np.array([name in relative for name in names]),
    }


def _inner_sizes(model: Model) -> str:
    """Return the sizes that only the functions need."""
    arrays = model.arrays
    sizes: dict[str, float] = {
        "N_SCORES": 1 if len(model.labels) == 2 else len(model.labels),
        "N_WHITENINGS": len(arrays["neighbourhood.whitening"]),
        "N_TESTS": len(_TESTED),
    }
    if _bands(model) is not None:
        sizes |= {"WINDOW_TIME": WINDOW_TIME, "EARLY_TIME": EARLY_TIME, "PI": np.pi}
    if model.guards:
        sizes["N_GUARDS"] = len(model.guards)
    if model.family == "network":
        sizes |= {f"N_UNITS_{k}": len(arrays[f"family.biases_{k}"]) for k in (1, 2)}
    if model.family == "boosting":
        sizes["N_TREES"] = len(arrays["family.roots"])
    if model.contrast is not None:
        sizes |= {f"N_CONTRAST_{k}": len(arrays[f"contrast.biases_{k}"]) for k in (1, 2)}
        sizes |= {"N_FEATURES": len(model.features), "N_CONTRASTED": len(model.measured)}
    return "\n".join(f"#define {name} {number}" for name, number in sizes.items()) + "\n"


def _arrays(model: Model) -> dict[str, NDArray[Any]]:
    """Return all tables of the file by their names in C."""
    stored = model.arrays
    names = [STANDARDISER + name for name in Standardiser.NAMES]
    names += ["neighbourhood.centres", "neighbourhood.whitening"]
    names += [name for name in stored if name.startswith(("family.", "contrast."))]
    arrays = {name.replace(".", "_"): stored[name] for name in names}
    for owner in ("standardiser", "contrast"):
        if f"{owner}_floor" in arrays:  # logarithms of smaller numbers would be those of 0 in single precision
            arrays[f"{owner}_floor"] = np.maximum(arrays[f"{owner}_floor"], 1e-300)
    if model.family == "boosting":
        leaf = arrays["family_left"] == np.arange(len(arrays["family_left"]))
        arrays["family_number"] = np.where(leaf, arrays.pop("family_value"), arrays.pop("family_threshold"))
    scalars = {"temperature": model.temperature, "neighbourhood_limit": model.neighbourhood_limit}
    if model.contrast is not None:
        arrays.pop("contrast_limit")
        scalars |= {"contrast_limit": model.contrast.limit, "contrast_spread": model.contrast.SCALE}
    arrays |= {name: np.array(value) for name, value in scalars.items()}
    if model.guards:
        arrays["guard_limits"] = np.array(model.guard_limits)
    arrays |= _bands(model) or {}
    if model.conformal is not None:
        arrays |= {"cgid_coverages": np.array(COVERAGES), "set_limits": _set_limits(model)}
    return arrays | _tests(model)


def _set_limits(model: Model) -> Floats:
    """Return the largest score of each label in a set, (2 n_coverages, n_labels); 1, all labels, without a limit."""
    limits = []
    assert model.conformal is not None
    for by_label in (False, True):
        for coverage in COVERAGES:
            try:
                limits.append(model.conformal.thresholds(coverage, class_conditional=by_label))
            except InvalidValue:
                limits.append(np.ones(len(model.labels)))
    return np.array(limits)


def _tests(model: Model) -> dict[str, Floats]:
    """Return rows and their probabilities for the self-test."""
    rows = np.array([Standardiser.from_arrays(model.arrays, STANDARDISER).at(place) for place in _TESTED])
    guards = np.broadcast_to(np.array(model.guard_limits) / 2, (len(rows), len(model.guards)))
    return {"test_values": np.hstack([rows, guards]), "test_probabilities": model.probabilities(rows)}


def _single(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the refusal of single precision, for a model whose numbers exceed it."""
    small, large = _SINGLE
    numbers = [np.abs(array[array != 0]) for array in arrays.values() if array.dtype.kind == "f"]
    if all(((some > small) & (some < large)).all() for some in numbers):
        return ""
    return '#error "this model has numbers beyond single precision: leave CGID_REAL double"\n'


def _has_layers(model: Model) -> bool:
    return model.family == "network" or model.contrast is not None


def _novelty(model: Model) -> str:
    return _NOVELTY % {
        "more": (_GUARDS if model.guards else "") + (_STRANGERS if model.contrast is not None else ""),
        "unused": "" if model.guards or model.contrast is not None else "    (void)values;\n",
    }


def _answer(model: Model) -> str:
    low, high = model.sampling_rates
    if model.beam is not None:
        low, high = LOWEST_SHARE * low, 1e300
    rates = {"lowest": repr(0.99 * low), "highest": repr(1.01 * high)}
    own = _ANSWER % {"ones": ", ".join("1" for _ in model.labels), **rates}
    measuring = _MEASURE_BODY if _bands(model) is not None else ""
    return own + (_SETS_BODY if model.conformal is not None else "") + measuring


# -- C as text --------------------------------------------------------------------------------------------


def _comment(text: str) -> str:
    """Return a line for a comment: ASCII, and nothing that would end it or that a compiler warns of."""
    plain = text.encode("ascii", "backslashreplace").decode()
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def _strings(name: str, size: str, texts: Iterable[str]) -> str:
    return f"const char *const {name}[{size}] = {{\n" + "".join(f"    {_quoted(text)},\n" for text in texts) + "};\n"


def _quoted(text: str) -> str:
    """Return a string of C: UTF-8, with octal escapes for all but plain signs."""
    plain = (chr(byte) if re.match(rb"[\w .-]", bytes([byte])) else f"\\{byte:03o}" for byte in text.encode())
    return f'"{"".join(plain)}"'


def _table(name: str, array: NDArray[Any]) -> str:
    """Return the definition of a table, or of one number."""
    kind = _type_of(name, array)
    public = name.startswith("cgid_")
    if not array.ndim:
        return f"static const {kind} {name} = {_number(array.item())};\n"
    text = ", ".join(map(_number, array.ravel().tolist()))
    lines = textwrap.fill(text, _LONGEST_LINE, initial_indent="    ", subsequent_indent="    ")
    return f"{'' if public else 'static '}const {kind} {name}[{array.size}] = {{\n{lines}\n}};\n"


def _type_of(name: str, array: NDArray[Any]) -> str:
    """Return the C type of a table: the smallest that holds whole numbers; sets and tests stay double."""
    if array.dtype.kind == "f":
        return "double" if name in _ALWAYS_DOUBLE else "cgid_real"
    most = int(array.max())
    return "unsigned char" if most < 1 << 8 else "unsigned short" if most < 1 << 16 else "unsigned long"


def _number(value: float) -> str:
    return str(int(value)) if isinstance(value, bool | int) else repr(value)
