/* The C of `cgid.export`, in parts that each follow a line with their name. An exported file has those parts that its
   model needs; %(name)s is filled in where a part has it. */
//: types
#ifndef CGID_REAL
#define CGID_REAL double
#endif
typedef CGID_REAL cgid_real;
//: interface
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
extern const char *const cgid_columns[CGID_N_VALUES];  /* the same as `cgid features` names its columns */

/* Identify one impact from its CGID_N_VALUES values, in the order of cgid_values; return the status. */
cgid_status cgid_identify(const cgid_real *values, cgid_answer *answer);

/* Return the label of the smallest expected cost; `costs` are those of missing each label. */
int cgid_decide(const cgid_real *probability, const cgid_real *costs);

/* Return 1 if the model was trained for a sampling rate [Hz], else 0. */
int cgid_covers(double sampling_rate);

/* Return the number of wrong answers to a few impacts that cgid itself has answered: 0 if compiler, processor and
   options are sound. */
int cgid_self_test(void);
//: sets

/* Coverages of the prediction sets. */
#define CGID_N_COVERAGES %(n)d
extern const double cgid_coverages[CGID_N_COVERAGES];

/* Find the labels that cannot be ruled out, held[label] = 1, at the coverage of this number; return how many. For
   impacts like those of the training, this share of the sets holds the truth, for the mix of labels of the training.
   Where too few impacts were left out for a limit, no label is ruled out. */
int cgid_prediction_set(const cgid_real *probability, int coverage, unsigned char *held);
//: measure

/* Measure one frame of a vibration: n_samples in the unit of the model, of which the first pre_trigger precede the
   touch. Return 1, or 0 and values that are not numbers if it cannot be measured. Computes in double precision; its
   time grows with the number of samples times the number of bins of the spectrum up to the highest band. */
int cgid_measure(const cgid_real *samples, int n_samples, int pre_trigger, double sampling_rate, cgid_real *values);
//: together

/* Identify one impact that up to CGID_N_CHANNELS channels of one beam measure: n times CGID_N_VALUES values, of a channel
   that does not measure it not numbers. The probabilities are the mean of the log-odds of the channels, and the novelty
   is that of their mean values; where that is outside of the training, those channels count that are inside. */
cgid_status cgid_together(const cgid_real *values, int n, cgid_answer *answer);
//: arithmetic
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
#define CGID_LEAST 1e-300
#define CGID_DIGITS 17
#elif CGID_JOIN(CGID_BYTES_, CGID_REAL) == 4
%(single)s#define CGID_EXP expf
#define CGID_LOG logf
#define CGID_SQRT sqrtf
#define CGID_TANH tanhf
#define CGID_READ strtof
#define CGID_TOLERANCE 1e-3
#define CGID_LARGEST 80
#define CGID_LEAST 1e-37f
#define CGID_DIGITS 9
#else
#error "CGID_REAL must be float or double"
#endif
//: standardise
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
//: layer
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
//: scores of linear
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
//: scores of logistic
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
//: scores of network
/* Two hidden layers. */
static void scores(const cgid_real *x, cgid_real *score)
{
    cgid_real first[N_UNITS_1], second[N_UNITS_2];
    layer(x, CGID_N_INPUTS, family_weights_1, family_biases_1, N_UNITS_1, 1, first);
    layer(first, N_UNITS_1, family_weights_2, family_biases_2, N_UNITS_2, 1, second);
    layer(second, N_UNITS_2, family_weights_3, family_biases_3, N_SCORES, 0, score);
}
//: probabilities
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
//: contrast
/* Novelty against anything else, by features and guards: that of strangers, or of noise. */
static cgid_real contrast(const cgid_real *values)
{
    cgid_real x[N_CONTRASTED], score;
    int i;
    for (i = 0; i < N_CONTRASTED; i++) {
        x[i] = values[i < N_FEATURES ? i : i - N_FEATURES + CGID_N_INPUTS];
    }
    standardise(x, N_CONTRASTED, contrast_logarithmic, contrast_floor, contrast_mean, contrast_scale, x);
%(score)s    score = (score - contrast_limit) / contrast_spread;
    return CGID_EXP(score > CGID_LARGEST ? (cgid_real)CGID_LARGEST : score);
}
//: contrast by a network
    cgid_real first[N_CONTRAST_1], second[N_CONTRAST_2];
    layer(x, N_CONTRASTED, contrast_weights_1, contrast_biases_1, N_CONTRAST_1, 1, first);
    layer(first, N_CONTRAST_1, contrast_weights_2, contrast_biases_2, N_CONTRAST_2, 1, second);
    layer(second, N_CONTRAST_2, contrast_weights_3, contrast_biases_3, 1, 0, &score);
//: contrast by a line
    layer(x, N_CONTRASTED, contrast_coefficients, contrast_intercepts, 1, 0, &score);
//: novelty
/* The largest of the distance, the guards over their limits, and the contrast; infinite beyond all numbers. */
static cgid_real novelty(const cgid_real *values, const cgid_real *x)
{
    cgid_real most = distance(x);
%(unused)s%(more)s    return isnan(most) ? (cgid_real)HUGE_VAL : most;
}
//: guards
    for (int i = 0; i < N_GUARDS; i++) {
        cgid_real guard = values[CGID_N_INPUTS + i] / guard_limits[i];
        most = guard > most ? guard : most;
    }
//: strangers
    cgid_real stranger = contrast(values);
    most = stranger > most || isnan(stranger) ? stranger : most;
//: answer
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
%(above)s    int i, finite = 1;
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
%(floored)s    standardise(values, CGID_N_INPUTS, standardiser_logarithmic, standardiser_floor, standardiser_mean,
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
//: floored
    for (i = 0; i < CGID_N_VALUES; i++) {
        above[i] = i < CGID_N_INPUTS && values[i] < floor_levels[i] ? floor_levels[i] : values[i];
    }
    values = above;
//: body of together
/* Set the probabilities to the mean of the log-odds of the answers that count; no label is surer than in any of them. */
static void mean_of_log_odds(const cgid_answer *answers, const unsigned char *counts, int n, cgid_answer *out)
{
    cgid_real logs[CGID_N_LABELS], plain[CGID_N_LABELS], highest = 0, largest = 0, sum = 0, share = 0;
    int c, k, used = 0;
    for (c = 0; c < n; c++) {
        used += counts[c];
    }
    for (k = 0; k < CGID_N_LABELS; k++) {
        logs[k] = plain[k] = 0;
        for (c = 0; c < n; c++) {
            if (counts[c]) {
                cgid_real p = answers[c].probability[k];
                logs[k] += CGID_LOG(p > (cgid_real)CGID_LEAST ? p : (cgid_real)CGID_LEAST) / (cgid_real)used;
                plain[k] += p / (cgid_real)used;
                highest = p > highest ? p : highest;
            }
        }
        largest = k == 0 || logs[k] > largest ? logs[k] : largest;
    }
    for (k = 0; k < CGID_N_LABELS; k++) {
        logs[k] = CGID_EXP(logs[k] - largest);
        sum += logs[k];
    }
    for (k = 0; k < CGID_N_LABELS; k++) {
        logs[k] /= sum;
        if (logs[k] > highest && logs[k] > plain[k]) {
            cgid_real one = (logs[k] - highest) / (logs[k] - plain[k]);
            share = one > share ? one : share;
        }
    }
    for (k = 0; k < CGID_N_LABELS; k++) {
        out->probability[k] = (1 - share) * logs[k] + share * plain[k];
    }
}

cgid_status cgid_together(const cgid_real *values, int n, cgid_answer *answer)
{
    cgid_answer own[CGID_N_CHANNELS];
    unsigned char measured[CGID_N_CHANNELS], inside[CGID_N_CHANNELS];
    cgid_real joined[CGID_N_VALUES];
    int c = 0, i, n_measured = 0, n_inside = 0, best = 0;
    do {
        cgid_identify(values + c * CGID_N_VALUES, own + c);
        measured[c] = own[c].status == CGID_KNOWN || own[c].status == CGID_OUTSIDE;
        inside[c] = own[c].status == CGID_KNOWN;
        n_measured += measured[c];
        n_inside += inside[c];
        best = measured[c] && (!measured[best] || own[c].novelty < own[best].novelty) ? c : best;
    } while (++c < n);
    *answer = own[best];
    if (n_measured < 2) {
        return answer->status;
    }
    for (i = 0; i < CGID_N_VALUES; i++) {
        cgid_real sum = 0, logs = 0;
        int linear = together_linear[i];
        for (c = 0; c < n; c++) {
            if (measured[c]) {
                cgid_real value = values[c * CGID_N_VALUES + i];
                linear = linear || value <= 0;
                sum += value / (cgid_real)n_measured;
                logs += value > 0 ? CGID_LOG(value) / (cgid_real)n_measured : 0;
            }
        }
        joined[i] = linear ? sum : CGID_EXP(logs);
    }
    cgid_identify(joined, answer);
    if (answer->status == CGID_OUTSIDE && n_inside > 0) {
        *answer = own[best];
        for (c = 0; c < n; c++) {
            answer->novelty = inside[c] && own[c].novelty > answer->novelty ? own[c].novelty : answer->novelty;
            measured[c] = inside[c];
        }
    }
    mean_of_log_odds(own, measured, n, answer);
    if (answer->status == CGID_KNOWN) {
        answer->label = cgid_decide(answer->probability, even_costs);
    }
    return answer->status;
}
//: body of sets

int cgid_prediction_set(const cgid_real *probability, int coverage, unsigned char *held)
{
    int k, n = 0;
    for (k = 0; k < CGID_N_LABELS; k++) {
        held[k] = 1.0 - (double)probability[k] <= set_limits[coverage];
        n += held[k];
    }
    return n;
}
//: body of measure

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
//: main
#ifdef CGID_MAIN
/* Read a CSV of impacts, from a file or the standard input, and print one answer a line. A first line of names, such
   as `cgid features` prints, says which columns hold the values; without it they come in the order of cgid_values. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef CGID_N_CHANNELS
#define N_COLUMNS (CGID_N_CHANNELS * CGID_N_VALUES)
#else
#define N_COLUMNS CGID_N_VALUES
#endif

static char line[64 * N_COLUMNS + 16384];

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

/* Return the number of the value that a column names, with or without its unit; -1 if it is none. The values of the
   second channel of a beam follow those of the first. */
static int value_named(const char *name)
{
    int i;
    for (i = 0; i < N_COLUMNS; i++) {
        const char *value = cgid_values[i % CGID_N_VALUES], *title = cgid_columns[i % CGID_N_VALUES];
        size_t n = strlen(value);
        if (i < CGID_N_VALUES && (strcmp(name, title) == 0 || strcmp(name, value) == 0)) {
            return i;
        }
#ifdef CGID_N_CHANNELS
        if (strncmp(name, value, n) == 0) {
            char *end;
            if (strncmp(name + n, " of channel ", 12) == 0 && strtol(name + n + 12, &end, 10) == i / CGID_N_VALUES + 1
                && (*end == '\0' || strcmp(end, title + n) == 0)) {
                return i;
            }
        }
#else
        (void)n;
#endif
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
    for (i = 0; i < N_COLUMNS; i++) {
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
    int i, k, found = 0, needed = 0;
    for (i = 0; i < N_COLUMNS; i++) {
        values[i] = (cgid_real)NAN;
        needed += column[i] >= 0;
    }
    for (k = 0; (field = next_field(&rest)) != NULL; k++) {
        for (i = 0; i < N_COLUMNS; i++) {
            if (column[i] == k) {
                if (!number_of(field, values + i)) {
                    return complain(number, "there must be a number, got ", field);
                }
                found++;
            }
        }
    }
    return found == needed ? 0 : complain(number, "there must be a field for each value", "");
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
    static int column[N_COLUMNS];
    static cgid_real values[N_COLUMNS];
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
        printf(",p_%s", cgid_labels[k]);
    }
    printf(",novelty,problem\n");
    for (k = 0; k < N_COLUMNS; k++) {
        column[k] = k < CGID_N_VALUES ? k : -1;
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
#ifdef CGID_N_CHANNELS
            cgid_together(values, CGID_N_CHANNELS, &answer);
#else
            cgid_identify(values, &answer);
#endif
            print_answer(&answer);
            first = 0;
        }
    }
    return fflush(stdout) && !code ? 74 : code;
}
#endif
